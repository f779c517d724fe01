"""Take identity out of a Percept session report before it is stored.

The lists name what stays, not what goes: known sections and keys of the report. Under them stay numbers, enumerations, times and the few
texts with a technical shape. The result decodes to the same recordings, apart from the device's name, which becomes a keyed pseudonym.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

from ml.formats.archive import ZipFiles, told
from ml.formats.options import ArchiveLimits
from ml.formats.percept.annotations import SECTION, as_section, gather, speaks_of
from ml.formats.percept.enums import UNKNOWN, is_known, mask
from ml.formats.percept.keys import KEYS
from ml.formats.percept.report import report_members
from ml.formats.percept.report_json import HINT, SECTIONS, channel_names, moment, read_report
from ml.formats.percept.words import EVENT_WORDS, cleaned
from ml.formats.recording import UndecodableFile
from ml.formats.redaction_record import Redaction, number_in, pseudonym
from ml.formats.source import Source

EPOCH = (1980, 1, 1, 0, 0, 0)
SERIAL = "NeurostimulatorSerialNumber"
BLANKED = frozenset({"PatientInformation", "ProgrammerTimezone", "ProgrammerLocale", "FeatureInformationCode", "PrescriptionSummary"})
"""Sections that identify a person or a place; the programmer's offset from UTC stays."""

DEEPEST = 40
MOST_NAMED = 8
"""Unknown sections or fields that one sentence names."""

HEMISPHERE = re.compile(r"HemisphereLocationDef[._](Left|Right)")
NUMBERS = re.compile(r"\s*\[?[\d\s,.eE+-]*\]?\s*")
PACKET_LISTS = frozenset({"GlobalSequences", "GlobalPacketSizes", "TicksInMses", "TicksInMs"})
VERSION = re.compile(r"\d{1,4}(\.\d{1,5}){0,4}")
TEXTS = {
    "ProgrammerUtcOffset": re.compile(r"[+-]\d\d:\d\d"),
    "ProgrammerVersion": VERSION,
    "DataVersion": VERSION,
    "ProductVersion": VERSION,
    "DeviceVersion": VERSION,
    "CoreVersion": VERSION,
    "Neurostimulator": re.compile(r"Percept (PC|RC)"),
    "NeurostimulatorModel": re.compile(r"B\d{5}"),
    "StatusBytes": re.compile(r"([0-9A-F]{2} ?){1,8}"),
    "SurveyMode": re.compile(r"ElectrodeSurvey|ElectrodeIdentifier"),
    "Pass": re.compile(r"(FIRST|SECOND|THIRD)_PASS|SQC|((ZERO|ONE|TWO|THREE)_?)+"),
}
ENUM = re.compile(r"(Ins(Location|Port)|[A-Za-z…]{1,40}Def)[._][A-Za-z0-9_…]{1,60}")
"""What looks like an enumeration; only those of `enums.py` stay."""


def redact_percept(source: Source, target: Path, key: bytes, limits: ArchiveLimits | None = None) -> Redaction:
    """Write the session report, or the zip of reports, without identity; the same bytes in give the same bytes out.

    Args:
        source: the uploaded file.
        target: where the redacted file is written: JSON for JSON, a zip for a zip.
        key: secret of the installation, at least 16 bytes.
        limits: bounds for an archive.

    Raises:
        UndecodableFile: no report in it can be parsed; nothing is written then.
    """
    pseudonym("check of the key", key)
    scrub = _Scrubber(key)
    done = Redaction()
    with source.open("rb") as stream:
        zipped = stream.read(4) == b"PK\x03\x04"
    if not zipped:
        with source.open("rb") as stream:
            clean = scrub.report(read_report(stream, done.repaired))
        target.write_bytes(_dump(clean))
    else:
        with ZipFiles(source, limits or ArchiveLimits()) as files:
            members = report_members(files, damaged=True)
            texts = {f"report-{n}.json": t for n, m in enumerate(members, start=1) if (t := _member(files, m, n, scrub, done)) is not None}
            others = len(files.names()) - len(members)
            done.ignored += [
                *told(files.left_out),
                *([f"{others} file{'s' if others > 1 else ''} that are no session report"] if others else []),
            ]
        if not texts:
            why = f": {done.unreadable[0]}" if done.unreadable else ""
            raise UndecodableFile(f"no Percept session report in here can be read{why}", "archive", HINT)
        with zipfile.ZipFile(target, "w") as archive:
            for name, text in texts.items():
                info = zipfile.ZipInfo(name, EPOCH)
                info.compress_type = zipfile.ZIP_DEFLATED
                info.create_system, info.external_attr = 3, 0o100600 << 16
                archive.writestr(info, text)
        done.removed.append("names of files")
    done.removed += scrub.sentences()
    return done


def _member(files: ZipFiles, member: str, number: int, scrub: _Scrubber, done: Redaction) -> bytes | None:
    """Clean one report of an archive; None, and a sentence, where it cannot be read."""
    try:
        with files.open(member) as stream:
            return _dump(scrub.report(read_report(stream, done.repaired)))
    except UndecodableFile as error:
        done.unreadable.append(f"report {number}: {error.stored_what}")
        return None


def _dump(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=True).encode()


class _Scrubber:
    """Cleans JSON values and counts what it takes out."""

    def __init__(self, key: bytes) -> None:
        self._key = key
        self._gone: Counter[str] = Counter()
        self._named: dict[str, Counter[str]] = {"section": Counter(), "key": Counter(), "enum": Counter()}
        self._lost: Counter[str] = Counter()

    def report(self, report: dict[str, Any]) -> dict[str, Any]:
        """Remove identity from the report."""
        out: dict[str, Any] = {}
        for name, value in report.items():
            if name in BLANKED:
                self._gone["patient" if name == "PatientInformation" else "place"] += 1
            elif name in SECTIONS:
                out[name] = self._clean(value, name, 1)
            elif not speaks_of(name):
                self._unknown("section", name)
        noted = gather(report)
        self._lost.update(noted.lost)
        if noted.kept:
            out[SECTION] = as_section(noted)
        return out

    def _unknown(self, what: str, name: str) -> None:
        self._gone[what] += 1
        self._named[what][cleaned(name)] += 1

    def _clean(self, node: Any, key: str, depth: int) -> Any:
        if depth > DEEPEST:
            self._gone["deep"] += 1
            return None
        if isinstance(node, dict):
            kept = (self._entry(name, item, depth) for name, item in node.items())
            return {name: value for name, value in kept if value is not _GONE}
        if isinstance(node, list):
            if all(type(v) is float or type(v) is int for v in node):
                return node
            return [self._clean(item, key, depth + 1) for item in node]
        if isinstance(node, str) and node:
            return self._text(node, key)
        return node

    def _entry(self, name: str, item: Any, depth: int) -> tuple[str, Any]:
        if name == SERIAL:
            if not isinstance(item, str) or not item.strip():
                return name, ""
            self._gone["device"] += 1
            return name, pseudonym(item, self._key)
        if not (name in KEYS or HEMISPHERE.fullmatch(name) or moment(name) is not None):
            if isinstance(item, str) and ENUM.fullmatch(item):
                # a state of the device under a new name: what of both is technical stays, so that the history can show it
                self._unknown("key", name)
                return cleaned(name), self._text(item, name)
            if not speaks_of(name) and name != cleaned(name):
                self._unknown("key", name)
            return name, _GONE
        return name, self._clean(item, name, depth + 1)

    def _text(self, text: str, key: str) -> str:
        if self._technical(text, key):
            return text
        if (shown := mask(text)) is not None and ENUM.fullmatch(text):
            if UNKNOWN not in text:
                self._gone["enum"] += 1
                self._named["enum"][shown] += 1
            return shown
        self._gone["text"] += 1
        return ""

    @staticmethod
    def _technical(text: str, key: str) -> bool:
        if len(text) > 120 and key not in PACKET_LISTS:
            return False
        if key in PACKET_LISTS:
            return NUMBERS.fullmatch(text) is not None
        if key in ("Channel", "SensingChannel") and "." not in text:
            return len(channel_names(text)) == text.count(",") + 1
        if key == "EventName":
            return text.strip().lower() in EVENT_WORDS
        if (shape := TEXTS.get(key)) is not None:
            return shape.fullmatch(text) is not None
        if key.endswith(("DateTime", "Date", "date")):
            return moment(text) is not None
        return is_known(text) or number_in(text) is not None

    def sentences(self) -> list[str]:
        """List what was removed, without showing any of it."""
        said = {
            "patient": "the patient's details (PatientInformation: names, date of birth, identifier, notes, diagnosis)",
            "place": "time zone and language of the programmer, feature codes (the offset from UTC stays)",
            "device": "serial number of the neurostimulator: a keyed pseudonym stays",
            "section": "sections not known to be technical",
            "enum": "words of enumerations that no report is known to have",
            "text": "texts not known to be technical, such as names of events",
            "key": "fields not known to be technical, such as names of devices and groups, notes and the date of the implant",
            "deep": "parts nested beyond reason",
        }
        lost = [f"{reason} ({count}×)" for reason, count in self._lost.items()]
        return [
            *(f"{text} ({self._gone[name]}×{self._names_of(name)})" for name, text in said.items() if self._gone[name]),
            *([f"of annotations and ratings: {', '.join(lost)}"] if lost else []),
        ]

    def _names_of(self, what: str) -> str:
        """Name what was removed, as far as the names are technical."""
        names = [name for name, _ in self._named.get(what, Counter()).most_common() if name != "…"]
        more = f" and {len(names) - MOST_NAMED} others" if len(names) > MOST_NAMED else ""
        return f": {', '.join(names[:MOST_NAMED])}{more}" if names else ""


_GONE = object()
