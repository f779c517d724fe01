"""Policies of a participant: trained, external and baseline ones."""
