"""Calibration: estimates made before a visit against what the visit brought."""
