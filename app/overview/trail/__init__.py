"""Which part of the audit trail somebody reads who does not read all of it."""
