"""Estimates held against actual returns, against each other, and combined."""
