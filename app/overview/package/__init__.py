"""A participant's record as a Frictionless data package, with a script that recomputes the primary tables."""
