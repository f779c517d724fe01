"""Visit plans: drafted from a ranking, approved by a clinician, printed."""
