"""Enrolment: the form, what a study code may not give away, and the first settings."""
