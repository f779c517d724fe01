"""Database, files, jobs, security, audit and charts: what every phase stands on."""
