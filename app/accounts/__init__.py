"""People: users, memberships and roles, sign-in sessions, API tokens."""
