"""Data queries: a monitor or coordinator asks about a value, somebody answers, and the one who may ask closes it."""
