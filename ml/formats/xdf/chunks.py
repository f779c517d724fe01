"""Chunks of an XDF file, and the head of each stream. Source: XDF specification 1.0 (github.com/sccn/xdf/wiki/Specifications)."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO
from xml.etree import ElementTree  # a text with a document type, which could expand, is refused before it is parsed

from ml.formats.recording import UndecodableFile

MAGIC = b"XDF:"
FILE_HEADER, STREAM_HEADER, SAMPLES, CLOCK_OFFSET, BOUNDARY, STREAM_FOOTER = 1, 2, 3, 4, 5, 6
OF_A_STREAM = (STREAM_HEADER, SAMPLES, CLOCK_OFFSET, STREAM_FOOTER)
SIGNATURE = bytes.fromhex("43a546dccbf5410fb30ed5467383cbe4")
FORMATS = {"int8": ("b", 1), "int16": ("h", 2), "int32": ("i", 4), "int64": ("q", 8), "float32": ("f", 4), "double64": ("d", 8)}
"""Struct's letter and bytes of one value."""
LARGEST_CHUNK = 64 << 20
MOST_CHANNELS = 1024
MOST_STREAMS = 200
_BLOCK = 1 << 20
_LENGTHS = {1: "<B", 4: "<I", 8: "<Q"}


@dataclass(slots=True)
class Damage:
    """Account of what could not be read: places that were stepped over, and the byte at which the file ends within a chunk."""

    skipped: int = 0
    cut_at: int | None = None


@dataclass(frozen=True, slots=True)
class Chunk:
    """One chunk: tag, stream (0 where it is of none), content after the stream's number; `damaged`: something before it was lost."""

    tag: int
    stream: int
    content: bytes
    damaged: bool = False


def chunks(stream: BinaryIO, damage: Damage) -> Iterator[Chunk]:
    """Yield the whole chunks of a file; after a damaged one the next boundary is looked for."""
    if stream.read(4) != MAGIC:
        raise UndecodableFile("this is no XDF file", "first bytes", "Send the file as the recorder wrote it.")
    lost = False
    while True:
        at = stream.tell()
        found = _next(stream)
        if isinstance(found, Chunk):
            yield Chunk(found.tag, found.stream, found.content, lost)
            lost = False
        elif found:
            return
        elif _to_boundary(stream, at + 1):
            damage.skipped += 1
            lost = True
        else:
            damage.cut_at = at
            return


def _next(stream: BinaryIO) -> Chunk | bool:
    """Read one chunk; True at the end of the file, False where it is not whole."""
    first = stream.read(1)
    if not first:
        return True
    if (form := _LENGTHS.get(first[0])) is None:
        return False
    raw = stream.read(first[0])
    if len(raw) < first[0]:
        return False
    length = struct.unpack(form, raw)[0]
    if not 2 <= length <= LARGEST_CHUNK:
        return False
    body = stream.read(length)
    if len(body) < length:
        return False
    tag = int.from_bytes(body[:2], "little")
    if tag in OF_A_STREAM:
        return Chunk(tag, int.from_bytes(body[2:6], "little"), body[6:]) if length >= 6 else False
    return Chunk(tag, 0, body[2:]) if tag in (FILE_HEADER, BOUNDARY) else False


def _to_boundary(stream: BinaryIO, begin: int) -> bool:
    """Move behind the next boundary chunk from a place on; False where there is none."""
    stream.seek(begin)
    before = b""
    while block := stream.read(_BLOCK):
        place = (before + block).find(SIGNATURE)
        if place >= 0:
            stream.seek(begin + place + len(SIGNATURE))
            return True
        begin += len(before) + len(block) - len(SIGNATURE)
        before = (before + block)[-len(SIGNATURE) :]
        begin = stream.tell() - len(before)
    return False


def pack_chunk(tag: int, content: bytes, stream: int = 0) -> bytes:
    """Write one chunk."""
    body = struct.pack("<H", tag) + (struct.pack("<I", stream) if tag in OF_A_STREAM else b"") + content
    return (struct.pack("<BB", 1, len(body)) if len(body) < 256 else struct.pack("<BI", 4, len(body))) + body


def read_length(content: bytes, place: int) -> tuple[int, int]:
    """Read a number of variable length; returns it and the place after it. Raises ValueError where there is none."""
    if place >= len(content) or (form := _LENGTHS.get(content[place])) is None or place + 1 + content[place] > len(content):
        raise ValueError("no length")
    size = content[place]
    return int(struct.unpack_from(form, content, place + 1)[0]), place + 1 + size


def tree_of(content: bytes) -> ElementTree.Element:
    """Parse the text of a header or footer. Raises ValueError where it is none, or has a document type."""
    text = content.decode("utf-8", "replace").strip("\0 \t\r\n")
    if "<!" in text or re.search(r"<\?xml-stylesheet", text):
        raise ValueError("a document type")
    try:
        return ElementTree.fromstring(text)  # noqa: S314  # see the import
    except ElementTree.ParseError as error:
        raise ValueError("no XML") from error


def text_of(tree: ElementTree.Element, path: str) -> str:
    """Return the text at a path, without spaces around it; empty where there is none."""
    return (tree.findtext(path) or "").strip()
