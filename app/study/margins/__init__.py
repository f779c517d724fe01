"""Margins of a participant: by how much an outcome may be worse than under cDBS; and the levels of verdicts. Versioned."""
