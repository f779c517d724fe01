"""What the embedded PostgreSQL needs once per machine or data folder: a system user, a place, roles with passwords."""
