"""The step between two visits of the paper: continue from the policies that did best in their sessions, and train fresh ones as well."""
