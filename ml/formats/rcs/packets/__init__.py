"""Packets of RC+S streams: tolerant and compiled reading, arrays, and their times."""
