"""Summit RC+S session folders, zipped or as a folder. Source: the format notes, part A.

Any stream may be missing, empty or cut: what is there is decoded, and a report per file says what was and was not.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from ml.formats.archive import READ_ERRORS, Files, FolderFiles, ZipFiles, hint_of, told
from ml.formats.loose import MIXED, LooseFiles, Opening, group
from ml.formats.options import DecodeOptions
from ml.formats.rcs.leads import leads_only
from ml.formats.rcs.opening import HEAD, STEM_OF, read_opening, stem_in_name
from ml.formats.rcs.packets.json_elements import JsonNotes, read_elements
from ml.formats.rcs.packets.scan import Batch, batch_of, scan
from ml.formats.rcs.packets.streams import (
    Adaptive,
    Interval,
    read_accel,
    read_adaptive,
    read_fft,
    read_power,
    read_time_domain,
    read_time_sync,
)
from ml.formats.rcs.recording import Streams, build_recording
from ml.formats.rcs.settings import RECORDS_LOST, Lost, Settings, follow, host_ms
from ml.formats.recording import DecodedFile, FileReport, Problem, RecordingLog, UndecodableFile

T = TypeVar("T")
MAX_RECORDS = 200_000
NEEDED = ("DeviceSettings", "StimLog", "RawDataTD", "RawDataPower", "AdaptiveLog", "EventLog")
"""Files whose absence is worth a word."""

TELLING = ("DeviceSettings", "StimLog", "AdaptiveLog")
"""Files that say which amplitude was delivered: where part of one is lost, that is reported as a loss, not as a repair."""

COUNTED = {"ErrorLog": "errors", "DiagnosticsLog": "diagnostics"}
KEY_OF = {stem: key for key, stem in STEM_OF.items()}
KNOWN = {name.lower(): name for name in (*NEEDED, *KEY_OF, *COUNTED)}
NEEDED_SETTINGS = (
    "RecordInfo", "UtcOffset", "GeneralData", "SensingConfig", "SenseState", "AdaptiveConfig", "DetectionConfig", "BatteryStatus"
)  # fmt: skip
SLOW_BATCH = 256
MAX_PACKETS = 2_000_000
MAX_NUMBERS = 64_000_000
"""Packets and samples that are taken of one file: 55 h of ten packets, 9 h of 2000 samples a second, the most the device can stream."""


@dataclass(slots=True)
class SessionFiles:
    """One device folder: the member of each known file, and the reports so far."""

    members: dict[str, str]
    label: str
    reports: dict[str, FileReport] = field(default_factory=dict)

    def report(self, stem: str) -> FileReport:
        """Return the report of one of the folder's files; its name never shows the folder, which may contain a serial number."""
        return self.reports.setdefault(stem, FileReport(f"{self.label}{stem}.json"))


def decode_rcs(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a zip, or a folder, that holds one or more RC+S device folders.

    Raises:
        UndecodableFile: no zip, unsafe, or without any RC+S file.
    """
    if path.is_dir():
        return decode_files(FolderFiles(path), options, name or "session folder")
    with ZipFiles(path, options.archive) as files:
        return decode_files(files, options, name or path.name)


def holds_session(files: Files, report: FileReport) -> bool:
    """Decide whether any of the files is of a session; the report counts those that are not."""
    return bool(find_sessions(files, report))


def decode_files(files: Files, options: DecodeOptions, name: str) -> DecodedFile:
    """Decode every device folder among the files; see `decode_rcs`."""
    whole = FileReport(name)
    sessions = find_sessions(files, whole)
    whole.ignored.extend(told(files.left_out))
    if not sessions:
        hint = hint_of(files.left_out, "Zip the session's Device folder with its JSON files (DeviceSettings, StimLog, RawDataTD, …).")
        raise UndecodableFile("no RC+S session in here", name, hint)
    recordings: list[RecordingLog] = []
    reports = [whole]
    for session in sessions:
        recording = decode_session(session, files, options)
        if any(recording.fingerprint == other.fingerprint for other in recordings):
            whole.ignored.append(f"{session.label or 'session'}: the same recording stands in the archive twice; counted once")
        else:
            recordings.append(recording)
        reports.extend(session.reports.values())
    if all(_is_empty(r) for r in recordings):
        said = "this upload holds no data: no stream has a sample and no stimulation log an amplitude; kept as a recording without data"
        whole.flagged.insert(0, said)
    whole.understood.append(f"{len(recordings)} RC+S recording{'s' if len(recordings) != 1 else ''}")
    return DecodedFile(tuple(recordings), tuple(reports))


def _is_empty(recording: RecordingLog) -> bool:
    """Decide whether a recording has neither a sample nor an amplitude in its stimulation log."""
    logged = (e.data for e in recording.events if e.kind == "stimulation" and e.data["origin"] == "StimLog")
    stimulated = any(program["amplitude_ma"] is not None for data in logged for program in data["programs"])
    return recording.duration_s == 0 and not recording.traces and not stimulated


def find_sessions(files: Files, report: FileReport) -> list[SessionFiles]:
    """Group known files by folder, and within a folder by the implant and the session that they name: two recordings are never mixed.

    A file is known by its name, else by its content. The others are counted in the report, without their names, which may identify a
    person.
    """
    folders: dict[str, list[tuple[str, str, Opening]]] = defaultdict(list)
    unknown = 0
    for name in files.names():
        path = PurePosixPath(name)
        opening = _opening(files, name)
        stem = _stem_of(path) or opening.stem
        if stem is None:
            unknown += 1
        else:
            folders[str(path.parent)].append((stem, name, opening))
    if unknown:
        report.ignored.append(f"{unknown} file{'s' if unknown != 1 else ''} not of an RC+S session")
    found = [members for _, listed in sorted(folders.items()) for members in _apart(listed, report)]
    return [SessionFiles(members, f"recording {i}: " if len(found) > 1 else "") for i, members in enumerate(found, start=1)]


def _stem_of(path: PurePosixPath) -> str | None:
    """Find which file of a session has this very name."""
    return KNOWN.get(path.stem.lower()) if path.suffix.lower() == ".json" else None


def read_loose(name: str, head: bytes) -> Opening:
    """Find which file of a session a loose file is: by its name or its content. Where that is empty or damaged, the beginning of its name
    decides."""
    path, opening = PurePosixPath(name), read_opening(head)
    begun = stem_in_name(path.name) if path.suffix.lower() == ".json" else None
    return replace(opening, stem=_stem_of(path) or opening.stem or begun)


LOOSE = LooseFiles("RC+S files", HEAD, read_loose)


def _opening(files: Files, name: str) -> Opening:
    """Read the beginning of a file; one that cannot be unpacked gives nothing here and is reported when it is read."""
    try:
        with files.open(name) as stream:
            return read_opening(stream.read(HEAD))
    except (UndecodableFile, *READ_ERRORS):
        return Opening()


def _apart(listed: Sequence[tuple[str, str, Opening]], report: FileReport) -> list[dict[str, str]]:
    """Split the files of one folder into one or more recordings, each from stem to name; ignored files are reported."""
    groups = group([opening for _, _, opening in listed])
    if len(groups.recordings) > 1:
        report.flagged.append(MIXED.format(len(groups.recordings)))
    if groups.homeless:
        report.ignored.append(f"{len(groups.homeless)} empty files that do not say which of these recordings they belong to")
    out: list[dict[str, str]] = []
    for places in groups.recordings:
        # of two files of one kind the one with the device's own name counts
        mine = sorted((listed[i] for i in places), key=lambda m: PurePosixPath(m[1]).stem.lower() not in KNOWN)
        members: dict[str, str] = {}
        for stem, name, _ in mine:
            if members.setdefault(stem, name) != name:
                report.ignored.append(f"{stem} stands more than once in one folder; one of them was used")
        out.append(dict(sorted(members.items())))
    return out


def decode_session(session: SessionFiles, files: Files, options: DecodeOptions) -> RecordingLog:
    """Decode one device folder; never raises for a defect of one file."""
    streams = read_streams(session, files)
    for stem in NEEDED:
        if stem not in session.members:
            session.report(stem).flagged.append("not in the upload; the recording was decoded without it")
    return build_recording(streams, session.report, options)


def read_streams(session: SessionFiles, files: Files) -> Streams:
    """Read everything in one device folder, not yet placed in time; the reports list the defects."""
    infos: list[dict[str, Any]] = []
    records = {stem: _records(session, files, stem, infos) for stem in ("DeviceSettings", "StimLog", "EventLog")}
    settings = follow(records["DeviceSettings"], records["StimLog"])
    interval_at = _interval_at(settings)

    def adaptive(records: Iterator[Any]) -> Adaptive:
        return read_adaptive(_without_losses(records, settings), interval_at)

    return Streams(
        time_domain=_stream(session, files, "RawDataTD", infos, read_time_domain),
        power=_stream(session, files, "RawDataPower", infos, lambda packets: read_power(packets, interval_at)),
        adaptive=_stream(session, files, "AdaptiveLog", infos, adaptive),
        accel=_stream(session, files, "RawDataAccel", infos, read_accel),
        fft=_stream(session, files, "RawDataFFT", infos, lambda packets: read_fft(packets, interval_at)),
        time_sync=_stream(session, files, "TimeSync", infos, read_time_sync),
        settings=settings,
        notes=records["EventLog"],
        infos=infos,
        counts={name: sum(1 for _ in _elements(session, files, stem, infos)) for stem, name in COUNTED.items() if stem in session.members},
    )


def _without_losses(records: Iterable[Any], settings: Settings) -> Iterator[Any]:
    """Yield the records of the adaptive log; the settings note where some are lost."""
    for record in records:
        if isinstance(record, Lost):
            settings.adaptive_lost = True
        else:
            yield record


def _interval_at(settings: Settings) -> Interval:
    def interval_at(pc_ms: float) -> float | None:
        state = settings.sensing.at(pc_ms if pc_ms == pc_ms else -1.0)
        return None if state is None else state.fft_interval_s

    return interval_at


def _elements(session: SessionFiles, files: Files, stem: str, infos: list[dict[str, Any]], notes: JsonNotes | None = None) -> Iterator[Any]:
    """Yield the records of one file, or its packets, in runs where they are plain, and a `Lost` where a log lacks some.

    The file's report is complete when the iterator is exhausted.
    """
    report = session.report(stem)
    notes = JsonNotes()
    wanted = KEY_OF.get(stem)
    try:
        with files.open(session.members[stem]) as stream:
            damaged = 0
            for element, _ in read_elements(stream, notes, scan if wanted else None):
                if notes.damaged > damaged and stem in TELLING:
                    yield Lost()
                damaged = notes.damaged
                if isinstance(element, dict) and element.get(RECORDS_LOST):
                    notes.elements -= 1
                    yield Lost(host_ms(element))
                else:
                    yield element
    except UndecodableFile as error:
        session.reports[stem] = FileReport(report.name, problem=Problem(error.what, report.name, error.hint))
        if stem in TELLING:
            yield Lost()
        return
    if stem in TELLING and (notes.cut or notes.damaged > damaged):
        yield Lost(notes.cut_ms)
    infos.extend(notes.record_infos[:1])
    (report.flagged if stem in TELLING and (notes.cut or notes.damaged) else report.repaired).extend(notes.defects)
    if notes.stream_key is not None and notes.stream_key != wanted:
        report.flagged.append(f"holds {notes.stream_key}, not what its name says")
    if notes.elements == 0:
        report.flagged.append("holds no data")
    else:
        one = "packet" if wanted else "record"
        report.understood.append(f"{notes.elements} {one}{'' if notes.elements == 1 else 's'}")


def _limit(elements: Iterable[Any], report: FileReport) -> Iterator[Any]:
    """Yield elements up to the memory limit of one file; the report counts those beyond."""
    packets = numbers = beyond = 0
    for element in elements:
        size, many = (element.size, element.pool.size) if isinstance(element, Batch) else (1, 0)
        if beyond or packets + size > MAX_PACKETS or numbers + many > MAX_NUMBERS:
            beyond += size
        else:
            packets, numbers = packets + size, numbers + many
            yield element
    if beyond:
        report.flagged.append(f"longer than any recording of the device: {beyond} packets at its end were left out")


def _batches(elements: Iterable[Any]) -> Iterator[Batch]:
    """Yield packets in the order of the file, whichever way they were read."""
    others: list[Any] = []
    for element in elements:
        plain = isinstance(element, Batch)
        if others and (plain or len(others) == SLOW_BATCH):
            yield batch_of(others)
            others.clear()
        if plain:
            yield element
        else:
            others.append(element)
    if others:
        yield batch_of(others)


def _records(session: SessionFiles, files: Files, stem: str, infos: list[dict[str, Any]]) -> list[Any]:
    """Read the records of a record file, reduced to the parts that are used; a missing stimulation log is a loss of all of it."""
    if stem not in session.members:
        return [Lost()] if stem == "StimLog" else []
    out: list[Any] = []
    for record in _elements(session, files, stem, infos):
        if not isinstance(record, dict):
            out += [record] if isinstance(record, Lost) else []
            continue
        if stem == "DeviceSettings":
            record = {
                k: v for k, v in record.items() if k in NEEDED_SETTINGS or k.startswith(("TherapyConfigGroup", "AmplitudeLimitsGroup"))
            } | leads_only(record)
        if len(out) == MAX_RECORDS:
            session.report(stem).flagged.append(f"more than {MAX_RECORDS} records; the rest was left out")
            out.append(Lost())
            break
        out.append(record)
    return out


def _stream(
    session: SessionFiles,
    files: Files,
    stem: str,
    infos: list[dict[str, Any]],
    read: Callable[[Iterator[Any]], T],
) -> T | None:
    """Read a stream file by `read`; None where the file is missing."""
    if stem not in session.members:
        return None
    report = session.report(stem)
    elements = _elements(session, files, stem, infos)
    return read(_limit(_batches(elements) if stem in KEY_OF else elements, report))
