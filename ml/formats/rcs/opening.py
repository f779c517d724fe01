"""Opening of an RC+S file: its first bytes show which file of a session it is, and of which implant and session.

Names of files are changed on the way (`RawDataTD (1).json`), and files of two implants may be in one folder. `RecordInfo` heads every
record, so the content identifies both.
"""

from __future__ import annotations

import json
import re

from ml.formats.loose import Opening

HEAD = 1 << 16
"""Bytes of a file that are looked at."""

STEM_OF = {
    "TimeDomainData": "RawDataTD",
    "PowerDomainData": "RawDataPower",
    "AccelData": "RawDataAccel",
    "FftData": "RawDataFFT",
    "TimeSyncData": "TimeSync",
}
_RECORDS = (
    ("AdaptiveLog", re.compile(r'"AdaptiveUpdate"\s*:')),
    ("DeviceSettings", re.compile(r'"(GeneralData|SensingConfig|UtcOffset|SubjectInfo|AmplitudeLimitsGroup\d)"\s*:')),
    ("EventLog", re.compile(r'"Event"\s*:\s*\{')),
    ("ErrorLog", re.compile(r'"Error"\s*:\s*\{')),
    ("DiagnosticsLog", re.compile(r'"(LatencyResultsDiagnostic|ReadFlashMirror|SessionInitWarnings)"\s*:')),
    ("StimLog", re.compile(r'"(therapyStatusData|TherapyConfigGroup\d)"\s*:')),
)
"""In this order, for settings hold what the log of stimulation holds too."""

_NAMES = (*STEM_OF.values(), *(stem for stem, _ in _RECORDS))
_NAME = re.compile(rf"({'|'.join(_NAMES)})(?![a-z0-9])", re.IGNORECASE)
_STREAM = re.compile(rf'"({"|".join(STEM_OF)})"\s*:\s*\[')
_INFO = re.compile(r'"RecordInfo"\s*:\s*(\{[^{}]*\})')
NAMED = re.compile(r"[A-Za-z0-9._ -]{1,64}")
"""A serial number, its pseudonym, or a time; anything else is damage and names nothing."""

_START = re.compile(r'[\s\ufeff]*(\[[\s,]*)?\{\s*"RecordInfo"')


def read_opening(head: bytes) -> Opening:
    """Read the first `HEAD` bytes of a file; nothing where they are no JSON with a RecordInfo."""
    text = head.decode("utf-8-sig", "replace")
    if text.strip(" \r\n\t\ufeff\0") in ("", "[]", "[{}]"):
        return Opening(empty=True)
    found = _INFO.search(text)
    info = _values(found[1]) if found else {}
    stem = None
    if _START.match(text) is not None:
        stream = _STREAM.search(text)
        stem = STEM_OF[stream[1]] if stream else next((name for name, shape in _RECORDS if shape.search(text)), None)
    return Opening(stem, _name_in(info, "DeviceId"), _name_in(info, "SessionId"))


def stem_in_name(name: str) -> str | None:
    """Find the file of a session that a changed name begins with, such as `rawdatatd (1)`."""
    match = _NAME.match(name)
    return next(n for n in _NAMES if n.lower() == match[1].lower()) if match else None


def _values(text: str) -> dict[str, object]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _name_in(info: dict[str, object], key: str) -> str | None:
    value = info.get(key)
    return value.strip().upper() if isinstance(value, str) and NAMED.fullmatch(value.strip()) else None
