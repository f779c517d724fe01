"""Replay of logged sessions in a model of beta's response to the amplitude over time, averaged over dose shapes and time scales."""
