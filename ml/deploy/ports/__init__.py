"""Ports of a policy: 400 windows with the dose due, and the check of the answers that a converted copy gives to them."""
