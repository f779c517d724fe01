"""The step between two visits of the paper: go on from the policies that did best in their sessions, and train fresh ones beside them."""
