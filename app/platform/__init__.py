"""Base of every phase: database, files, jobs, security, audit and charts."""
