"""Settings of a participant: the form and its page."""
