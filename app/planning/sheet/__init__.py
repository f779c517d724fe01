"""The sheet of a visit: the plan on paper and, in the same words, as a page."""
