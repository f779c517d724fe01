"""Sweeps: policies trained in one action, compared on sessions that they did not learn from."""
