"""What recordings hold besides the traces of sessions, and their charts."""
