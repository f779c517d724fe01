"""Controller bundle (network, C header, runner, limits, sheet) and the safety envelope around its network: all that leaves the service.

Source: Gao et al. 2023, sections 3 (the research tablet), 4.2 (distillation) and 6.1 (computation time). Guide: docs/deployment.md.
"""
