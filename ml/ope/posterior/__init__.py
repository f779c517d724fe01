"""From estimates to tests: the posterior over candidate policies, what to say of each, and which to test at the next visit."""
