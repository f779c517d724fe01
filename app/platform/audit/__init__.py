"""The audit trail: a row for every write, made by triggers; chained by hashes, and sealed with a key outside the database."""

from app.platform.audit.trail import AUDITED, record, record_once, record_view

__all__ = ["AUDITED", "record", "record_once", "record_view"]
