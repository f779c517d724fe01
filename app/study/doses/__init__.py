"""Doses of medication with their times, and how long before a session the last one was."""
