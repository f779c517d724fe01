"""The embedded PostgreSQL: the server, and what it needs once per machine or data folder (a system user, a place, roles with passwords)."""
