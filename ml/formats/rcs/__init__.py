"""Medtronic Summit RC+S session folders."""
