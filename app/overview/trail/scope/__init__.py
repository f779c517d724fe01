"""Conditions that leave a part of the audit trail: of a reader, or of participants."""
