"""What leaves the building: the controller bundle and the safety envelope around its network.

Source: Gao et al. 2023, section 3 (the research tablet).
"""
