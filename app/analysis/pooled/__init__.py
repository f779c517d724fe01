"""All participants together: a result for each, a summary that claims nothing about a population, and the paper's tables."""
