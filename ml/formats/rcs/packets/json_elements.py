"""Tolerant reading of RC+S JSON: one packet or record at a time, so that a defect costs only the packet it is in.

Real files hold bare NaN, `INF` and cut ends (see the format notes, A.10). The reader looks for elements of the innermost list of
interest: packets under a stream key, or whole records. It holds one chunk of text, never the file.

With a scanner, runs of plain packets go through it and come out as one batch. The reader steps in for every other packet.
"""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from typing import IO, Any

from ml.formats.archive import READ_ERRORS
from ml.formats.rcs.packets.scan import PADDING, Batch

STREAM_KEYS = ("TimeDomainData", "AccelData", "PowerDomainData", "FftData", "TimeSyncData")
CHUNK = 1 << 20
MAX_ELEMENT = 8 << 20
"""Characters one packet or record may have; a larger one is no RC+S packet."""

NEAR_END = 1 << 16
"""An error this close to the end of the text read so far may be a token cut by the chunk's end."""

MAX_DEPTH = 64
"""Levels of nesting in one element; the device writes ten."""

TOO_DEEP = "brackets nested deeper than any device writes them; that part was left out"

MAX_DAMAGED = 1_000
"""Damaged packets after which a file is given up: no recording is like that, and each costs a search."""

Scanner = Callable[[bytes, int], tuple[Batch, int, bool]]
"""Such as `rcs_scan.scan`: padded text and a place in it to plain packets, where they end, and whether the next is only cut."""

_INF = re.compile(r"(?<=[\[:,\s])([+-]?)(?:INF|Inf|inf)(?=[\],}\s])")
_SPACE = re.compile(r"[\s,\ufeff\x00]*")
_COLON = re.compile(r"\s*:\s*")
_OPEN = re.compile(r'"(' + "|".join(STREAM_KEYS) + r')"\s*:\s*\[')
_HEAD_MS = re.compile(r'\{\s*"RecordInfo"\s*:\s*\{[^{}]{0,500}?"HostUnixTime"\s*:\s*([0-9]{1,15})\s*[,}]')
"""Head of a record with its whole PC time."""

_NEXT = {"packets": re.compile(r'\{\s*"Header"'), "records": re.compile(r'\{\s*"RecordInfo"')}


@dataclass(slots=True)
class JsonNotes:
    """Findings while one file is read. The reader fills it in; it is complete when the reader is exhausted.

    Attributes:
        unread_fields: fields of stream objects other than `RecordInfo` and the packets; they are stepped over.
        cut: the end of the file is missing, so that nothing is known of what followed.
        cut_ms: PC time of the cut record, ms, where its head is whole.
    """

    defects: list[str] = field(default_factory=list)
    elements: int = 0
    stream_key: str | None = None
    record_infos: list[dict[str, Any]] = field(default_factory=list)
    damaged: int = 0
    unread_fields: int = 0
    cut: bool = False
    cut_ms: float | None = None


class _Text:
    """A window of decoded text over a byte stream."""

    def __init__(self, stream: IO[bytes], notes: JsonNotes) -> None:
        self._stream = stream
        self._decoder = codecs.getincrementaldecoder("utf-8-sig")("replace")
        self._notes = notes
        self.text = ""
        self.at = 0
        self.ended = False
        self.mending_inf = False
        self._plain = ("", b"")

    def more(self) -> bool:
        """Read another chunk, dropping what was used; False at the end of the file."""
        if self.ended:
            return False
        try:
            raw = self._stream.read(CHUNK)
        except READ_ERRORS:
            self._notes.defects.append("the compressed data are damaged; everything before the damage was read")
            self._notes.cut = True
            raw = b""
        self.ended = not raw
        fresh = self._decoder.decode(raw, final=self.ended)
        if self.mending_inf:
            seam = max(self.at, len(self.text) - 16)
            self.text, fresh = self.text[:seam], _INF.sub(r"\1Infinity", self.text[seam:] + fresh)
        self.text = self.text[self.at :] + fresh
        self.at = 0
        return not self.ended

    def plain(self) -> bytes | None:
        """Encode the text as padded bytes; None where bytes and characters do not count the same."""
        if self._plain[0] is not self.text:
            self._plain = (self.text, self.text.encode() + PADDING if self.text.isascii() else b"")
        return self._plain[1] or None

    def mend_inf(self, at: int) -> bool:
        """Spell an INF token at `at` the way the parser knows, here and in all that follows; True when there was one."""
        if self.mending_inf or _INF.search(self.text, max(self.at, at - 2), at + 12) is None:
            return False
        self.mending_inf = True
        self.text, self.at = _INF.sub(r"\1Infinity", self.text[self.at :]), 0
        return True

    def skip_space(self) -> str:
        """Skip blanks and commas; the next character, empty at the end of the file."""
        while True:
            match = _SPACE.match(self.text, self.at)
            self.at = match.end() if match else self.at
            if self.at < len(self.text):
                return self.text[self.at]
            if not self.more():
                return ""


def read_elements(stream: IO[bytes], notes: JsonNotes, scanner: Scanner | None = None) -> Iterator[tuple[Any, str]]:
    """Read packets of a stream file, or records of a record file, each with its original text.

    Args:
        stream: the file's bytes.
        notes: filled in while reading: defects, number of elements, the stream key, the first RecordInfo met.
        scanner: reads runs of plain packets; each run comes out as one `Batch` with the run's text, which is JSON once it has brackets.
    """
    window = _Text(stream, notes)
    decoder = json.JSONDecoder()
    first = window.skip_space()
    if first == "":
        notes.defects.append("the file is empty")
        notes.cut = True
        return
    if first == "[":
        window.at += 1
    elif first != "{":
        notes.defects.append("the text does not begin like a JSON list")
        notes.cut = True
        return
    closed = False
    while True:
        key = _enter_stream(window, notes, decoder)
        if key is not None:
            yield from _read_list(window, notes, decoder, "packets", scanner)
            closed = _leave_stream(window, notes, decoder)
            continue
        if window.skip_space() == "{":
            closed = yield from _read_list(window, notes, decoder, "records")
        else:
            closed = window.skip_space() == "]" or closed
        break
    if first == "[" and not closed:
        notes.cut = True
        _note(notes, "the end of the file is missing; every complete part before it was kept")


def _enter_stream(window: _Text, notes: JsonNotes, decoder: json.JSONDecoder) -> str | None:
    """Enter the list of a stream object `{RecordInfo, <Key>: [`, if one begins here, and return the key."""
    if window.skip_space() != "{":
        return None
    while len(window.text) - window.at < 4096 and window.more():
        pass
    match = _OPEN.search(window.text, window.at, window.at + 4096)
    if match is None:
        return None
    head = window.text[window.at : match.start()].rstrip().rstrip(",") + "}"
    try:
        fields = decoder.decode(head)
    except (ValueError, RecursionError):
        return None
    info = fields.get("RecordInfo")
    notes.unread_fields += len(fields) - ("RecordInfo" in fields)
    if isinstance(info, dict) and not notes.record_infos:
        notes.record_infos.append(info)
    notes.stream_key = notes.stream_key or match[1]
    window.at = match.end()
    return match[1]


def _leave_stream(window: _Text, notes: JsonNotes, decoder: json.JSONDecoder) -> bool:
    """Skip what closes a stream object, fields behind its packets included; True when the outer list is closed too."""
    if window.skip_space() == "]":
        window.at += 1
    while window.skip_space() == '"' and _skip_field(window, notes, decoder):
        notes.unread_fields += 1
    if window.skip_space() == "}":
        window.at += 1
    return window.skip_space() == "]"


def _skip_field(window: _Text, notes: JsonNotes, decoder: json.JSONDecoder) -> bool:
    """Skip one `"key": value`; False, and not moved, where it is damaged, cut, or longer than an element may be."""
    while True:
        try:
            key, end = decoder.raw_decode(window.text, window.at)
            colon = _COLON.match(window.text, end)
            value, end = decoder.raw_decode(window.text, colon.end() if colon else end)
        except RecursionError:
            return False
        except ValueError:
            colon, end = None, len(window.text)
        if end == len(window.text) and len(window.text) - window.at < MAX_ELEMENT and window.more():
            continue  # it may go on in the next chunk
        if colon is None:
            return False
        if key in STREAM_KEYS and value:
            _note(notes, f"a second list of packets in one object ({key}) was left out")
        window.at = end
        return True


def _read_list(
    window: _Text, notes: JsonNotes, decoder: json.JSONDecoder, kind: str, scanner: Scanner | None = None
) -> Generator[tuple[Any, str], None, bool]:
    """Yield elements until the list closes; returns True when it does."""
    while True:
        mark = window.skip_space()
        if scanner is not None and mark == "{":
            yield from _scan(window, notes, scanner)
            mark = window.skip_space()
        if mark == "]":
            return True
        if mark == "":
            notes.cut = True
            if kind == "packets":
                _note(notes, "the end of the file is missing; every complete part before it was kept")
            return False
        element = _element(window, notes, decoder) if mark == "{" else None
        if element is not None:
            value, text = element
            if not notes.record_infos and isinstance(value, dict) and isinstance(value.get("RecordInfo"), dict):
                notes.record_infos.append(value["RecordInfo"])
            notes.elements += 1
            yield value, text
        elif kind == "packets" and mark == "}":
            _note(notes, "a list of packets is not closed")
            return False
        elif not _resync(window, notes, kind):
            return False


def _scan(window: _Text, notes: JsonNotes, scanner: Scanner) -> Iterator[tuple[Batch, str]]:
    """Yield the plain packets from here on; afterwards the window is at something else."""
    while window.skip_space() == "{" and (raw := window.plain()) is not None:
        batch, end, cut = scanner(raw, window.at)
        if batch.size:
            text = window.text[window.at : end]
            window.at = end
            notes.elements += batch.size
            yield batch, text
        elif not (cut and len(window.text) - window.at < MAX_ELEMENT and window.more()):
            return


def _element(window: _Text, notes: JsonNotes, decoder: json.JSONDecoder) -> tuple[Any, str] | None:
    """Parse the object that begins here, or return None when it is damaged."""
    while True:
        try:
            value, end = decoder.raw_decode(window.text, window.at)
        except RecursionError:
            _note(notes, TOO_DEEP)
            return None
        except ValueError as error:
            at = getattr(error, "pos", len(window.text))
            if at >= len(window.text) - NEAR_END and len(window.text) - window.at < MAX_ELEMENT and window.more():
                continue
            if window.mend_inf(at):
                _note(notes, "INF in place of a number, read as infinite")
                continue
            return None
        text = window.text[window.at : end]
        if text.count("{") + text.count("[") > MAX_DEPTH and _deeper(value, MAX_DEPTH):
            _note(notes, TOO_DEEP)
            return None
        window.at = end
        return value, text


def _deeper(value: Any, levels: int) -> bool:
    """Decide whether objects and lists are nested deeper than so many levels."""
    layer = [value]
    for _ in range(levels):
        inner = [item.values() if isinstance(item, dict) else item for item in layer]
        layer = [item for items in inner for item in items if isinstance(item, dict | list)]
        if not layer:
            return False
    return True


def _resync(window: _Text, notes: JsonNotes, kind: str) -> bool:
    """Find the next packet or record after a damaged one; False when there is none."""
    begin = _HEAD_MS.match(window.text, window.at)
    window.at += 1
    notes.damaged += 1
    if notes.damaged > MAX_DAMAGED:
        notes.cut = True
        _note(notes, f"more than {MAX_DAMAGED} damaged {kind}; the rest of the file was left out")
        return False
    while True:
        match = _NEXT[kind].search(window.text, window.at)
        if match is not None:
            _note(notes, f"a damaged {kind[:-1]} was left out")
            window.at = match.start()
            return True
        window.at = max(window.at, len(window.text) - 64)
        if not window.more():
            notes.cut, notes.cut_ms = True, float(begin[1]) if begin else None
            _note(notes, f"the last {kind[:-1]} is cut; every complete {kind[:-1]} before it was kept")
            window.at = len(window.text)
            return False


def _note(notes: JsonNotes, text: str) -> None:
    if text not in notes.defects:
        notes.defects.append(text)
