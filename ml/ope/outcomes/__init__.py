"""End-of-session outcomes (grasp, rating, tremor, r_end) from the minutes of a session: one hierarchical model for all methods."""
