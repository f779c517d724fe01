"""Contents of recordings besides the traces of sessions, and their charts."""
