"""Values that can be, but seldom are: what is usual, and what is asked about the rest."""
