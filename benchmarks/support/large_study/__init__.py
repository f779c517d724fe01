"""A large study for measuring pages: its rows, what people enter, and a session of many raw samples."""
