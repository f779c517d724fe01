"""Adverse events of a participant: what happened, how badly, under what; cleared by a clinician. Revisions are only added."""
