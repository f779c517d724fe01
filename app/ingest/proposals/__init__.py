"""Proposed sessions: made from uploads; a person corrects, splits, confirms or discards them."""
