"""Offline learning algorithms, one file each, and their registry. Files with a leading underscore hold what several of them share."""
