"""Formats of devices, one record each: detection, redaction, decoding and the words of the service derive from these.

A new format is its own package, with a `CODE`, and one record here. Records name the package, so that a process which reads no file does
not load its decoder.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import cast

from ml.formats.archive import Files
from ml.formats.facts import Facts
from ml.formats.loose import LooseFiles
from ml.formats.options import ArchiveLimits, DecodeOptions
from ml.formats.recording import DecodedFile, FileReport
from ml.formats.redaction_record import Redaction
from ml.formats.source import Source


@dataclass(frozen=True, kw_only=True)
class FormatCode:
    """Functions and facts of the package of a format.

    Attributes:
        begins: decides by a single file's first bytes whether it is of this format.
        within: decides whether files of an archive are of this format; the report takes what is ignored of it.
        redact: writes a file without identity, as `ml.formats.redact` says.
        decode: decodes a file without identity, as `ml.formats.decode` says.
        facts: clocks, counters, values without a reading, changes of the dose.
        example: writes a small file, with which a process loads all that its decoder needs; None: it needs nothing of its own.
        loose: how its files are put together where they come loose; None where one file is a whole recording.
    """

    begins: Callable[[bytes], bool]
    within: Callable[[Files, FileReport], bool]
    redact: Callable[[Source, Path, bytes, ArchiveLimits], Redaction]
    decode: Callable[[Path, DecodeOptions, str | None], DecodedFile]
    facts: Facts
    example: Callable[[Path], None] | None = None
    loose: LooseFiles | None = None


@dataclass(frozen=True, kw_only=True)
class DeviceFormat:
    """Format of one kind of device.

    Attributes:
        kind: as stored with files and recordings.
        device, file: names of the device and of its file, for people.
        upload: what to send, as part of a sentence.
        package: that has its `CODE`.
        sources: of beta, with the name of each that no other format has.
        magic: first bytes, without any of which a file is none of this format, so that its package is not asked.
        zipped: whether a zip that cannot be read is taken for one of this format, whose decoder then reports why.
    """

    kind: str
    device: str
    file: str
    upload: str
    package: str
    sources: Mapping[str, str]
    magic: tuple[bytes, ...] = ()
    zipped: bool = False

    @property
    def code(self) -> FormatCode:
        """Functions and facts of its package, which is loaded here."""
        return cast(FormatCode, import_module(self.package).CODE)


DEVICES = (
    DeviceFormat(
        kind="rcs",
        device="RC+S",
        file="RC+S session folder",
        upload="an RC+S session folder as a zip",
        package="ml.formats.rcs",
        sources={"device_power": "band power computed on the device"},
        zipped=True,
    ),
    DeviceFormat(
        kind="percept",
        device="Percept",
        file="Percept report",
        upload="a Percept session report (JSON)",
        package="ml.formats.percept",
        sources={"percept_lfp": "Percept band power"},
    ),
    DeviceFormat(
        kind="xdf",
        device="XDF",
        file="XDF recording",
        upload="an XDF recording (LSL)",
        package="ml.formats.xdf",
        sources={},
        magic=(b"XDF:",),
    ),
    DeviceFormat(
        kind="edf",
        device="EDF",
        file="EDF or BDF recording",
        upload="an EDF, EDF+ or BDF recording",
        package="ml.formats.edf",
        sources={},
        magic=(b"0       ", b"\xffBIOSEMI"),
    ),
    DeviceFormat(
        kind="nwb",
        device="NWB",
        file="NWB recording",
        upload="an NWB recording",
        package="ml.formats.nwb",
        sources={},
        magic=(b"\x89HDF\r\n\x1a\n",),
    ),
    DeviceFormat(
        kind="bids",
        device="BIDS",
        file="BIDS folder",
        upload="a zipped BIDS folder (iEEG) of one participant",
        package="ml.formats.bids",
        sources={},
    ),
    DeviceFormat(
        kind="brainvision",
        device="BrainVision",
        file="BrainVision recording",
        upload="the three files of a BrainVision recording",
        package="ml.formats.brainvision",
        sources={},
    ),
)
BY_KIND = {one.kind: one for one in DEVICES}
DEVICE_NAMES = {one.kind: one.device for one in DEVICES}
FILE_NAMES = {one.kind: one.file for one in DEVICES}
SOURCE_NAMES = {source: name for one in DEVICES for source, name in one.sources.items()}
