"""Offline reinforcement learning of stimulation policies. Source: Gao et al. 2023, section 4."""
