"""Estimates: what the child processes compute, which methods there are, coverage of the data, choice of the default method."""
