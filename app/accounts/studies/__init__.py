"""Studies, their sites, and who works in them in which role."""
