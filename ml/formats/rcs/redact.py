"""Take identity out of an RC+S archive before it is stored: names, serial numbers, dates of birth, free text, folder names.

The lists name what stays, not what goes. A field stays only where its key is known (`keys.py`). A text stays only where its key is known
for technical words of a known shape. The result decodes to the same recording, apart from the device's name, which becomes a keyed
pseudonym.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections import Counter
from collections.abc import Iterator
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import IO, Any

from ml.formats.archive import ZipFiles, hint_of, told
from ml.formats.options import ArchiveLimits
from ml.formats.rcs.folder import TELLING, SessionFiles, find_sessions
from ml.formats.rcs.keys import KEYS
from ml.formats.rcs.labels import NO_LABEL, parse, render
from ml.formats.rcs.leads import clean_leads
from ml.formats.rcs.opening import NAMED
from ml.formats.rcs.packets.json_elements import JsonNotes, read_elements
from ml.formats.rcs.packets.scan import Batch, scan
from ml.formats.rcs.settings import RECORDS_LOST
from ml.formats.recording import FileReport, UndecodableFile
from ml.formats.redaction_record import PSEUDONYM, Redaction, number_in, pseudonym
from ml.formats.source import Source

DEFLATE_LEVEL = 1
"""Packing is what cleaning an archive takes longest over: level 6 takes five times as long and saves a fifth."""

EPOCH = (1980, 1, 1, 0, 0, 0)
BLANKED = frozenset({"SubjectInfo", "LastPtmRtmInfo"})
SERIALS = frozenset({"telMDeviceId", "implantDate"})
GAIN_TRIM = re.compile(r"cfg_config_data\.dev\.HT_sns_amp\d_gain\d{3,4}_trim")
TEXTS = {
    "ApiVer": re.compile(r"\d{1,3}(\.\d{1,3}){0,3}"),
    "SessionId": re.compile(r"\d{13}"),
    "Units": re.compile(r"millivolts|milliseconds|centiG"),
    "DiagnosticType": re.compile(r"LatencyTestEvent"),
    "BatteryStatus": re.compile(r"Ok|Low"),
    "ModuleType": re.compile(r"Ctm2?"),
    "TelmMode": re.compile(r"MMode\d"),
    "WireType": re.compile(r"WirelessConnection|UsbConnection"),
    "name": GAIN_TRIM,
}
PACKET_WORDS = frozenset(
    re.findall(
        r"\w+",
        """Header dataSize dataType dataTypeSequence globalSequence info systemTick timestamp seconds user1 user2 PacketGenTime
        PacketRxUnixTime ChannelSamples Key Value DebugInfo EvokedMarker IncludedChannels SampleRate Units millivolts XSamples YSamples
        ZSamples centiG Bands ExternalValuesMask FftSize IsPowerChannelOverrange ValidDataMask Channel FftOutput LatencyMilliseconds""",
    )
)
_QUOTED = re.compile(r'"([^"]*)"')


def redact_rcs_zip(source: Source, target: Path, key: bytes, limits: ArchiveLimits | None = None) -> Redaction:
    """Write the archive without identity; the same bytes in give the same bytes out.

    Args:
        source: the uploaded zip.
        target: where the redacted zip is written.
        key: secret of the installation, at least 16 bytes.
        limits: bounds for the archive.

    Raises:
        UndecodableFile: no zip, unsafe, or without any RC+S file; nothing is written then.
    """
    with ZipFiles(source, limits or ArchiveLimits()) as files:
        listing = FileReport("archive")
        sessions = find_sessions(files, listing)
        if not sessions:
            hint = hint_of(files.left_out, "Zip the session's Device folder with its JSON files.")
            raise UndecodableFile("no RC+S session in here", "archive", hint)
        # in the archive that is written every recording has a folder of its own
        done = Redaction(repaired=listing.flagged, ignored=[*listing.ignored, *told(files.left_out)])
        scrub = _Scrubber(key)
        taken: set[str] = set()
        members = sorted(_plan(sessions, files, scrub, taken))
        with zipfile.ZipFile(target, "w") as archive:
            for name, stem, label, origin in members:
                _write_member(archive, (name, stem, label), files, origin, scrub, done)
        if len(done.unreadable) == len(members):
            what = "every file of the RC+S session is empty or cannot be read"
            raise UndecodableFile(what, "archive", "Zip the session's Device folder again, from where it was recorded.")
        done.removed = ["names of folders", *scrub.sentences()]
        return done


def _plan(sessions: list[SessionFiles], files: ZipFiles, scrub: _Scrubber, taken: set[str]) -> Iterator[tuple[str, str, str, str]]:
    """Yield (new name, stem, label, old name) of every member to write."""
    for session in sessions:
        folder = _folder(session, files, scrub)
        number = 2
        plain = folder
        while folder in taken:
            folder = f"{plain}-{number}"
            number += 1
        taken.add(folder)
        for stem, origin in session.members.items():
            yield f"{folder}/{stem}.json", stem, session.label, origin


def _folder(session: SessionFiles, files: ZipFiles, scrub: _Scrubber) -> str:
    """Name the folder of a session, from the content of its files."""
    path = PurePosixPath(next(iter(session.members.values())))
    serial = next((part[6:] for part in path.parts[::-1] if part.lower().startswith("device") and len(part) > 6), None)
    started = next((part[7:] for part in path.parts if re.fullmatch(r"session\d{13}", part, re.IGNORECASE)), None)
    for _, origin in sorted(session.members.items()):
        info = _first_info(files, origin)
        if info is not None:
            serial = info["DeviceId"] if isinstance(info.get("DeviceId"), str) and info["DeviceId"] else serial
            said = info.get("SessionId")
            started = started or (said if isinstance(said, str) and TEXTS["SessionId"].fullmatch(said) else None)
            break
    device = f"Device{scrub.device(serial or 'unknown')}"
    return f"Session{started}/{device}" if started else device


def _first_info(files: ZipFiles, name: str) -> dict[str, Any] | None:
    notes = JsonNotes()
    try:
        with files.open(name) as stream:
            for _ in read_elements(stream, notes):
                break
    except UndecodableFile:
        return None
    return notes.record_infos[0] if notes.record_infos else None


def _write_member(
    archive: zipfile.ZipFile, names: tuple[str, str, str], files: ZipFiles, origin: str, scrub: _Scrubber, done: Redaction
) -> None:
    """Copy one file's elements, scrubbed; a file without a readable start is ignored and named.

    A log of what was delivered keeps a mark where records are lost: without one its last record would seem to hold.
    """
    name, stem, label = names
    shown = f"{label}{stem}.json"
    notes = JsonNotes()
    info = zipfile.ZipInfo(name, EPOCH)
    info.compress_type = zipfile.ZIP_DEFLATED
    info._compresslevel = DEFLATE_LEVEL  # type: ignore[attr-defined, unused-ignore]  # no public name before Python 3.13
    info.create_system, info.external_attr = 3, 0o100600 << 16
    marked = stem in TELLING
    try:
        with files.open(origin) as stream:
            elements = read_elements(stream, notes, scan)
            first = next(elements, None)
            if first is None and notes.defects and not notes.record_infos:
                done.unreadable.append(f"{shown}: {notes.defects[0]}")
                if marked:
                    archive.writestr(info, f"[{_mark(None)}]")
                return
            with archive.open(info, "w", force_zip64=True) as out:
                _write_elements(out, first, elements, notes, scrub, marked)
    except UndecodableFile as error:
        done.unreadable.append(f"{shown}: {error.what}")
        return
    scrub.fields_left_out(notes.unread_fields)
    told = done.flagged if marked and (notes.cut or notes.damaged) else done.repaired
    told.extend(f"{shown}: {defect}" for defect in notes.defects)


def _write_elements(
    out: IO[bytes], first: tuple[Any, str] | None, rest: Iterator[tuple[Any, str]], notes: JsonNotes, scrub: _Scrubber, marked: bool
) -> None:
    key = notes.stream_key
    if key is not None:
        head = _dump(scrub.clean(notes.record_infos[0] if notes.record_infos else {}))
        out.write(f'[{{"RecordInfo":{head},"{key}":['.encode())
    else:
        out.write(b"[")
    damaged, comma = 0, b""
    for value, text in chain([first] if first is not None else [], rest):
        if marked and notes.damaged > damaged:
            out.write(comma + _mark(None).encode())
            comma = b","
        damaged = notes.damaged
        out.write(comma + scrub.text(value, text).encode())
        comma = b","
    if marked and (notes.cut or notes.damaged > damaged):
        out.write(comma + _mark(notes.cut_ms).encode())
    out.write(b"]}]" if key is not None else b"]")


def _mark(at_ms: float | None) -> str:
    """Write the record in the place of lost ones."""
    return _dump({"RecordInfo": {} if at_ms is None else {"HostUnixTime": int(at_ms)}, RECORDS_LOST: True})


def _dump(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=True)


class _Scrubber:
    """Cleans JSON values and counts what it takes out."""

    def __init__(self, key: bytes) -> None:
        self._key = key
        self._gone: Counter[str] = Counter()
        pseudonym("check of the key", key)

    def device(self, serial: str) -> str:
        """Replace the name of a device by its pseudonym."""
        if not PSEUDONYM.fullmatch(serial):
            self._gone["device"] += 1
        return pseudonym(serial, self._key)

    def fields_left_out(self, count: int) -> None:
        """Count fields that the reader stepped over."""
        self._gone["key"] += count

    def text(self, value: Any, text: str) -> str:
        """Clean JSON text of one element, or of a run; packets with nothing but known words are copied unchanged."""
        if isinstance(value, Batch):
            return text
        if "\\" not in text and PACKET_WORDS.issuperset(_QUOTED.findall(text)):
            return text
        return _dump(self.clean(value))

    def clean(self, node: Any, key: str = "") -> Any:
        """Remove identity from a value."""
        if isinstance(node, dict):
            if key == "Event":
                return self._event(node)
            return {k: v for name, item in node.items() for k, v in self._entry(name, item)}
        if isinstance(node, list):
            if key == "FactorySettings":
                node = [item for item in node if isinstance(item, dict) and GAIN_TRIM.fullmatch(str(item.get("name")))]
            return [self.clean(item, key) for item in node]
        if isinstance(node, str) and node:
            return self._string(node, key)
        return node

    def _entry(self, name: str, item: Any) -> Iterator[tuple[str, Any]]:
        if name in BLANKED:
            self._gone[name] += 1
            yield name, clean_leads(item) if name == "SubjectInfo" else {}
        elif name in SERIALS or "serial" in name.lower():
            self._gone["serial"] += 1
        elif name not in KEYS:
            self._gone["key"] += 1
        else:
            yield name, self.clean(item, name)

    def _string(self, text: str, key: str) -> str | int | float:
        if key == "DeviceId" and NAMED.fullmatch(text.strip()):
            return self.device(text)
        if (shape := TEXTS.get(key)) is not None and shape.fullmatch(text):
            return text
        if key not in TEXTS and key != "DeviceId" and (number := number_in(text)) is not None:
            return int(number) if number.is_integer() else number
        self._gone["text"] += 1
        return ""

    def _event(self, event: dict[str, Any]) -> dict[str, Any]:
        """Reduce an event to its times and its label by the grammar."""
        texts = [event.get(name) for name in ("EventType", "EventSubType", "EventName")]
        label = render(parse(*texts))
        self._gone["note"] += 1
        times: dict[str, Any] = {name: self.clean(event[name], name) for name in ("UnixOnsetTime", "UnixOffsetTime") if name in event}
        return {"EventName": "", "EventType": "" if label == NO_LABEL else label, "EventSubType": "", **times}

    def sentences(self) -> list[str]:
        """List what was removed, without showing any of it."""
        said = {
            "SubjectInfo": "subject's details (SubjectInfo: identifier, dates, sex, diagnosis, notes, program names): "
            "side and target of the leads stay",
            "LastPtmRtmInfo": "programmers' details (LastPtmRtmInfo)",
            "device": "device names: a keyed pseudonym stays",
            "serial": "serial numbers, telemetry addresses and the date of the implant",
            "note": "free text of operator's notes: amplitude, rate, pulse width, group and start or stop stay",
            "text": "other texts not known to be technical",
            "key": "fields that no RC+S file is known to have, with their numbers",
        }
        return [f"{text} ({self._gone[name]}×)" for name, text in said.items() if self._gone[name]]
