"""Replay of logged sessions under another policy in a linear model of beta."""
