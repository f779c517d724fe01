"""Cells of a table: rows split at their delimiter, numbers and dates as people and spreadsheets write them."""
