"""Percept session reports: read by `decode_percept`, freed of identity by `redact_percept`; the others recognise them."""

from ml.formats.percept.redact import redact_percept
from ml.formats.percept.report import decode_percept, report_members
from ml.formats.percept.report_json import looks_like_report

__all__ = ["decode_percept", "looks_like_report", "redact_percept", "report_members"]
