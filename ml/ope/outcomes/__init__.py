"""End-of-session outcomes and r_end from the minutes of a session: one hierarchical model for all methods."""
