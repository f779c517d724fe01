"""Upkeep of an installation: backup, restore, and a look at whether everything is in order."""
