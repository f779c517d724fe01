"""Buffer snapshots: which sessions a result rests on, and what they cover."""
