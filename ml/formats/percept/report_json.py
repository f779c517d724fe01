"""Percept session reports as JSON: read, and looked into without trusting any field to be there or to be what it should be.

Every section may be missing, a list of one may be the object itself, and numbers may be text. Enumerations come in unknown versions (format
notes, A′).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from ml.formats.archive import READ_ERRORS
from ml.formats.recording import UndecodableFile

MAX_BYTES = 128 * 1024**2
"""A report of a long day has some 50 MB."""

SECTIONS = frozenset(
    re.findall(
        r"\w+",
        """AbnormalEnd FullyReadForSession FeatureInformationCode DataVersion SessionDate SessionEndDate ProgrammerTimezone
        ProgrammerUtcOffset ProgrammerLocale ProgrammerVersion PatientInformation DeviceInformation BatteryInformation
        GroupUsagePercentage LeadConfiguration Stimulation Groups BatteryReminder MostRecentInSessionSignalCheck Impedance GroupHistory
        SenseChannelTests CalibrationTests LfpMontageTimeDomain IndefiniteStreaming BrainSenseTimeDomain BrainSenseLfp BrainSenseSurveys
        BrainSenseSurveysTimeDomain LFPMontage PatientEvents EventSummary DiagnosticData PrescriptionSummary""",
    )
)
"""Top-level keys of a session report."""

TELLING = SECTIONS - {"Groups", "Stimulation", "Impedance"}
"""Keys that no other kind of file has at its top."""

SIDES: tuple[Literal["left"], Literal["right"]] = ("left", "right")
HINT = "Export the session report from the programmer again, and upload it unchanged."

_TOP_KEY = re.compile(r'"([A-Za-z]{6,40})"\s*:')
_OPEN_STRING = re.compile(r'"(?:[^"\\]++|\\.)*+\\?\Z', re.DOTALL)
_INF = re.compile(r"(?<=[\[:,\s])([+-]?)(?:INF|Inf|inf)(?=[\],}\s])")
_CONTACT = r"(?:ZERO|ONE|TWO|THREE|FOUR|FIVE|SIX|SEVEN|EIGHT|NINE|TEN|ELEVEN)(?:_?[ABC])?"
_OFFSET = re.compile(r"(?P<sign>[+-])(?P<h>\d\d):(?P<m>[0-5]\d)(:\d\d)?", re.ASCII)
_CHANNEL = re.compile(rf"(?:ELECTRODE_)?{_CONTACT}(?:_(?:AND|{_CONTACT}|LEFT|RIGHT|RING|SEGMENT)){{0,8}}")


def looks_like_report(head: bytes) -> bool:
    """Decide whether the first bytes of a file are those of a JSON object with a key of a session report."""
    text = _text(head)
    return text is not None and text.lstrip().startswith("{") and any(m[1] in TELLING for m in _TOP_KEY.finditer(text))


def _text(raw: bytes) -> str | None:
    """Decode bytes to text, by their byte-order mark or as UTF-8; None for UTF-16 without a mark or worse."""
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", "replace")
    return None if b"\0" in raw else raw.decode("utf-8-sig", "replace")


def read_report(stream: IO[bytes], notes: list[str]) -> dict[str, Any]:
    """Read the report as plain values.

    Args:
        stream: its bytes.
        notes: receives each repair, in a sentence.

    Raises:
        UndecodableFile: empty, too large, not whole JSON, nested beyond reason, or no session report.
    """
    try:
        raw = stream.read(MAX_BYTES + 1)
    except READ_ERRORS as error:
        raise UndecodableFile("the compressed data are damaged", "file", "Zip the session report again.") from error
    if len(raw) > MAX_BYTES:
        raise UndecodableFile(f"a JSON file of more than {MAX_BYTES // 1024**2} MiB", "file", HINT)
    text = _text(raw)
    if text is None or not text.strip():
        raise UndecodableFile("the file is empty" if text is not None else "this is no text", "file", HINT)
    report = _parse(text, notes)
    if not isinstance(report, dict) or not SECTIONS & set(report):
        raise UndecodableFile("JSON, but no Percept session report: none of its sections is there", "file", HINT)
    return report


def _parse(text: str, notes: list[str]) -> Any:
    try:
        return json.loads(text)
    except RecursionError as error:
        raise UndecodableFile("brackets nested deeper than any programmer writes them", "file", HINT) from error
    except ValueError as error:
        mended = _INF.sub(r"\1Infinity", text)
        if mended != text:
            notes.append("INF in place of a number, read as a gap")
            return _parse(mended, notes)
        line = getattr(error, "lineno", None)
        at = getattr(error, "pos", 0)
        cut = at >= len(text.rstrip()) - 1 or _OPEN_STRING.match(text, at) is not None
        what = "the JSON text ends in the middle" if cut else "the JSON text is damaged"
        raise UndecodableFile(what, f"line {line}" if line else "file", HINT) from error


def entries(value: Any) -> list[dict[str, Any]]:
    """Read a section as a list of objects: a single object counts as a list of one, anything else as none."""
    if isinstance(value, dict):
        return [value]
    return [v for v in value if isinstance(v, dict)] if isinstance(value, list) else []


def inside(value: Any, *keys: str) -> Any:
    """Return the value below a path of keys, None where any is missing."""
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value


def finite(value: Any) -> float | None:
    """Read a finite number, also where it is written as text; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def samples(value: Any) -> NDArray[np.float64]:
    """Convert a list of numbers to float64 [n], NaN for what is none."""
    if not isinstance(value, list):
        return np.empty(0)
    try:
        out = np.array(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        out = np.empty((0, 0))
    if out.ndim != 1:
        out = np.array([np.nan if (number := finite(v)) is None else number for v in value], dtype=np.float64)
    out[~np.isfinite(out)] = np.nan
    return out


def packet_list(value: Any) -> NDArray[np.float64]:
    """Convert a list of packets in any of its spellings, `"1,2,"`, `"[1, 2]"` or `[1, 2]`, to float64 [n] with NaN for what is no
    number."""
    if isinstance(value, str):
        value = [part for part in (p.strip() for p in value.strip().strip("[]").split(",")) if part]
    elif isinstance(value, int | float):
        value = [value]
    return samples(value)


def moment(value: Any) -> datetime | None:
    """Parse a point in time; text without a zone is UTC, as the programmer writes it. None for anything else."""
    if not isinstance(value, str) or len(value) > 40:
        return None
    try:
        when = datetime.fromisoformat(value.strip())
        when = when.astimezone(UTC) if when.tzinfo is not None else when.replace(tzinfo=UTC)
    except (ValueError, OverflowError):
        return None
    return when if 1990 <= when.year <= 2200 else None


def has_zone(value: Any) -> bool:
    """Decide whether a point in time states its offset from UTC."""
    try:
        return isinstance(value, str) and datetime.fromisoformat(value.strip()).tzinfo is not None
    except ValueError:
        return False


def utc_offset_h(value: Any) -> float | None:
    """Parse the hours that the programmer's clock was ahead of UTC, from a text like `+01:00`; None for anything else."""
    found = _OFFSET.fullmatch(value.strip()) if isinstance(value, str) else None
    if found is None:
        return None
    hours = int(found["h"]) + int(found["m"]) / 60.0
    return None if hours > 14 else -hours if found["sign"] == "-" else hours


def side_of(value: Any) -> Literal["left", "right"] | None:
    """Find the side that a channel, a lead or a hemisphere names, None where it names none or both."""
    parts = re.split(r"[^a-z]+", value.lower()) if isinstance(value, str) else []
    named = [side for side in SIDES if side in parts]
    return named[0] if len(named) == 1 else None


def channel_names(value: Any) -> list[str]:
    """List the names of channels in a field, which may name two: `ZERO_TWO_LEFT,ONE_THREE_RIGHT`. Texts that are no channel are ignored."""
    if isinstance(value, str):
        value = value.split(",")
    parts: Iterable[Any] = value if isinstance(value, list) else []
    named = (p.strip().rpartition(".")[2] for p in parts if isinstance(p, str) and len(p) < 120)
    return [name for name in named if _CHANNEL.fullmatch(name)]
