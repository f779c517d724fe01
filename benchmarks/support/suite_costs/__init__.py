"""Plugins that `benchmarks/suite.py` gives to pytest."""
