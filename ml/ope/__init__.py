"""Off-policy evaluation: what a policy would do, from sessions that other controllers ran. Source: Gao et al. 2023, section 5."""
