"""One policy: what it does, what is expected of it, where it comes from."""
