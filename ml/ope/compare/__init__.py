"""Comparison of estimates with actual returns and with each other, and their combination."""
