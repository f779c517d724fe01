"""Visits: their pages and the form that corrects one."""
