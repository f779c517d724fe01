"""Single policies: their page, what they would have done in recorded sessions, and what tested sessions showed of them."""
