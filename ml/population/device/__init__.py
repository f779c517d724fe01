"""Simulated sessions written as real RC+S session folders."""
