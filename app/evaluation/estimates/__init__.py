"""Estimates: what the child processes compute, which methods there are, coverage of the data, errors on left-out controllers."""
