"""Synthetic participants and populations of known true returns: estimators and learners are measured on them, never fitted to them."""
