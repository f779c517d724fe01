"""Percept session reports: `CODE` is what the registry of formats takes of this package."""

from ml.formats.percept.facts import FACTS
from ml.formats.percept.redact import redact_percept
from ml.formats.percept.report import decode_percept, report_members
from ml.formats.percept.report_json import looks_like_report
from ml.formats.registry import FormatCode

CODE = FormatCode(
    begins=looks_like_report,
    within=lambda files, report: bool(report_members(files)),
    redact=redact_percept,
    decode=decode_percept,
    facts=FACTS,
)
