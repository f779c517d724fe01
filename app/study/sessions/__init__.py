"""One session: its page, charts, recordings, and where statements and recordings disagree."""
