"""REST routes and pages of participants, visits and characteristics: above the rules of sessions, outcomes and recordings."""
