"""The end of a study or of one of its sites, and opening it again."""
