"""The deep latent sequential model (DLSM). Source: Gao et al. 2023, section 5."""
