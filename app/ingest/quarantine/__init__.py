"""Quarantine: unreadable files, encrypted until a person releases or discards them."""
