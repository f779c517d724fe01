"""Fitted Q evaluation."""
