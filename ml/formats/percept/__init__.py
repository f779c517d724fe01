"""Medtronic Percept session reports (JSON)."""
