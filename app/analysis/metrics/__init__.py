"""The five metrics of every controller against cDBS."""
