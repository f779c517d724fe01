"""Take identity out of a BIDS folder before it is stored: each data file by its own format, its tables and sidecars rewritten."""

from __future__ import annotations

import json
import math
import re
import tempfile
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from ml.formats.archive import READ_ERRORS, Files, ZipFiles, told
from ml.formats.bids.folder import Run, find_runs, members_of, read_json, read_tsv
from ml.formats.brainvision.files import find_parts, read_text
from ml.formats.brainvision.files import read_head as read_brainvision_head
from ml.formats.brainvision.redact import archive_entry, clean_texts
from ml.formats.edf.head import read_head
from ml.formats.edf.redact import redact_edf
from ml.formats.labs.events import labels_of
from ml.formats.labs.marks import parse, render
from ml.formats.labs.names import clean_label, clean_unit
from ml.formats.nwb.redact import redact_nwb
from ml.formats.options import ArchiveLimits
from ml.formats.recording import UndecodableFile
from ml.formats.redaction_record import Redaction
from ml.formats.source import InMemory, Source
from ml.formats.tables.cells.numbers import MISSING, NotANumber, parse_number

TYPES = (
    "EEG", "ECOG", "SEEG", "DBS", "LFP", "VEOG", "HEOG", "EOG", "ECG", "EMG", "TRIG", "AUDIO", "PD", "EYEGAZE", "PUPIL", "MISC",
    "SYSCLOCK", "ADC", "DAC", "REF", "OTHER", "ACCEL", "GYRO", "MAGN",
)  # fmt: skip
SIDES = {"l": "L", "left": "L", "r": "R", "right": "R"}
RECORDING_TYPES = ("continuous", "discontinuous", "epoched")
TIME = re.compile(r"\d{4}-\d{2}-\d{2}T\d{2}:\d{2}:\d{2}(\.\d{1,9})?Z?")
NUMBERS = ("SamplingFrequency", "PowerLineFrequency", "RecordingDuration")
VERSION = '{"Name": "recording", "BIDSVersion": "1.10.0"}'
PEOPLE = ("participants.tsv", "participants.json", "README", "README.md", "CHANGES", "LICENSE", "dataset_description.json")


def redact_bids(source: Source, target: Path, key: bytes, limits: ArchiveLimits | None = None) -> Redaction:
    """Write the runs of a folder without identity; the same bytes in give the same bytes out.

    A run that cannot be cleaned is named in `unreadable`, and the others are written.

    Raises:
        UndecodableFile: no run can be cleaned, or they are of two participants; nothing is written then.
    """
    account = Redaction()
    limits = limits or ArchiveLimits()
    try:
        with ZipFiles(source, limits) as files, zipfile.ZipFile(target, "w") as archive:
            runs, sentences = find_runs(files)
            account.flagged += sentences
            archive.writestr(archive_entry("dataset_description.json"), VERSION)
            problems = []
            for number, run in enumerate(runs, start=1):
                try:
                    _write_run(files, run, number, archive, target.parent, key, limits, account)
                except UndecodableFile as problem:
                    problems.append(problem)
                    account.unreadable.append(f"run {number}: {problem.stored_what} ({problem.stored_where}). {problem.hint}")
            if len(problems) == len(runs):
                raise problems[0]
            _account(files, account)
            account.ignored += told(files.left_out)
    except UndecodableFile:
        target.unlink(missing_ok=True)
        raise
    return account


def _account(files: Files, account: Redaction) -> None:
    """Describe which files do not stay."""
    names = Counter(PurePosixPath(n).name if PurePosixPath(n).name in PEOPLE else n.rsplit("_", 1)[-1] for n in files.names())
    listed = [n for n in (*PEOPLE, "sessions.tsv", "coordsystem.json") if names[n]]
    account.removed.insert(0, "; ".join(["names of participant, sessions and files", *listed]))
    account.removed.append("other columns of channels.tsv, events.tsv and scans.tsv, and other fields of the sidecars")
    account.removed = list(dict.fromkeys(account.removed))


def _write_run(
    files: Files, run: Run, number: int, archive: zipfile.ZipFile, room: Path, key: bytes, limits: ArchiveLimits, account: Redaction
) -> None:
    """Write the data file of a run and what describes it, under names that are numbers."""
    tables = _channels(files, run), _events(files, run, key, account), _sidecar(read_json(files, run.sidecars)), _start(files, run)
    base = f"sub-01_task-rest_run-{number:03d}"
    try:
        labels = _write_data(files, run, f"{base}_ieeg", archive, room, key, limits, account)
    except READ_ERRORS as error:
        raise UndecodableFile("its data file is damaged in the archive", f"run {number}", "Zip the folder again.") from error
    channels, events, sidecar, start = tables
    texts = {"channels.tsv": _match(channels, labels, account), "events.tsv": events, "ieeg.json": sidecar}
    for suffix, text in texts.items():
        if text:
            archive.writestr(archive_entry(f"sub-01/ieeg/{base}_{suffix}"), text)
    if start:
        scans = f"filename\tacq_time\nieeg/{base}_ieeg{run.data.ending}\t{start}\n"
        archive.writestr(archive_entry(f"sub-01/{base}_scans.tsv"), scans)


def _write_data(
    files: Files, run: Run, base: str, archive: zipfile.ZipFile, room: Path, key: bytes, limits: ArchiveLimits, account: Redaction
) -> list[tuple[str, str]]:
    """Write the data file, cleaned by its own format; returns the labels of its channels, as they were and as they are."""
    view = members_of(run, files)
    if run.kind == "brainvision":
        parts = find_parts(view)
        if not parts:
            raise UndecodableFile("a header of BrainVision is none", run.data.path, "Send it as it was recorded.", None, "a header (.vhdr)")
        part = parts[0]
        with view.open(part.samples) as stream:
            samples = stream.read()
        header, markers = clean_texts(view, part, key, account)
        archive.writestr(archive_entry(f"sub-01/ieeg/{base}.vhdr"), header.format(base=base))
        if markers is not None:
            archive.writestr(archive_entry(f"sub-01/ieeg/{base}.vmrk"), markers.format(base=base))
        archive.writestr(archive_entry(f"sub-01/ieeg/{base}.eeg"), samples)
        names = [label for label, _, _ in read_brainvision_head(read_text(view, part.header)).channels]
        return [(name, clean_label(name, "", i)[0]) for i, name in enumerate(names, start=1)]
    with view.open(run.data.path) as stream:
        raw = InMemory(stream.read(), run.data.path)
    with tempfile.TemporaryDirectory(dir=room) as folder:
        clean = Path(folder) / "clean"
        own = (redact_edf if run.kind == "edf" else redact_nwb)(raw, clean, key, limits)
        with clean.open("rb") as stream, archive.open(archive_entry(f"sub-01/ieeg/{base}{run.data.ending}"), "w", force_zip64=True) as sink:
            while block := stream.read(1 << 20):
                sink.write(block)
    for name in ("removed", "flagged", "ignored"):
        getattr(account, name).extend(getattr(own, name))
    if run.kind == "nwb":
        return []
    signals = read_head(raw.content).signals
    return [(s.label, clean_label(s.label, "", i)[0]) for i, s in enumerate(signals, start=1) if not s.annotations]


def _channels(files: Files, run: Run) -> list[dict[str, str]]:
    """Read what may stay of channels.tsv, and the side of each electrode; names are still those of the file."""
    sides = {row.get("name", ""): SIDES.get(row.get("hemisphere", "").lower(), "n/a") for row in read_tsv(files, run.electrodes)}
    out = []
    for row in read_tsv(files, run.channels):
        notch = re.findall(r"\d{1,3}(?:\.\d)?", row.get("notch", "")) if row.get("notch", "").lower() not in MISSING else []
        kind, status = row.get("type", "").upper(), row.get("status", "").lower()
        out.append(
            {
                "name": row.get("name", ""),
                "type": kind if kind in TYPES else "n/a",
                "units": clean_unit(row.get("units", "")) or "n/a",
                "status": status if status in ("good", "bad") else "n/a",
                "notch": " ".join(notch) or "n/a",
                "hemisphere": sides.get(row.get("name", ""), SIDES.get(row.get("hemisphere", "").lower(), "n/a")),
            }
        )
    return out


def _match(rows: Sequence[dict[str, str]], labels: Sequence[tuple[str, str]], account: Redaction) -> str:
    """Write channels.tsv with the names that the cleaned data file has; without labels a row keeps its own name where that may stay."""
    if not rows:
        return ""
    left = list(rows)
    kept: list[Mapping[str, str]] = []
    for name, clean in labels:
        row = next((r for r in left if r["name"] == name), None)
        if row is not None:
            left.remove(row)
            kept.append({**row, "name": clean})
    if not labels:
        kept, left = [{**r, "name": clean_label(r["name"], "", 1)[0]} for r in rows if clean_label(r["name"], "", 1)[1]], []
    if left:
        account.flagged.append(f"{len(left)} rows of channels.tsv name no channel of the data file: excluded")
    if missing := len(labels) - len(kept) if labels else 0:
        account.flagged.append(f"{missing} channels of the data file are not in channels.tsv")
    return _tsv(kept, list(rows[0]))


def _tsv(rows: Sequence[Mapping[str, str]], heads: Sequence[str]) -> str:
    return "\n".join(["\t".join(heads), *("\t".join(r[h].replace("\t", " ") for h in heads) for r in rows), ""])


def _events(files: Files, run: Run, key: bytes, account: Redaction) -> str:
    """Write events.tsv with times and the labels of marks; a row without a time is excluded."""
    units = {name: str(one.get("Units", "")) for name, one in read_json(files, run.event_heads).items() if isinstance(one, dict)}
    out, without = [], 0
    for row in read_tsv(files, run.events):
        onset, duration, sample = (_number(row.get(name, "")) for name in ("onset", "duration", "sample"))
        if onset is None:
            without += 1
            continue
        cells = {name: cell for name, cell in row.items() if name not in ("onset", "duration", "sample")}
        times = [
            f"{onset:.9g}",
            f"{duration:.9g}" if duration and duration > 0 else "n/a",
            f"{sample:.12g}" if sample is not None else "n/a",
        ]
        out += ["\t".join([*times, label]) for label in labels_of(cells, units, key)]
    if without:
        account.flagged.append(f"{without} rows of events.tsv have no onset: excluded")
    return "\n".join(["onset\tduration\tsample\ttrial_type", *out, ""]) if out else ""


def _number(cell: str) -> float | None:
    try:
        return parse_number(cell)
    except NotANumber:
        return None


def _sidecar(fields: Mapping[str, Any]) -> str:
    """Write the fields of the sidecar that may stay."""
    kept: dict[str, Any] = {
        name: value for name in NUMBERS if isinstance(value := fields.get(name), int | float) and math.isfinite(value)
    }  # fmt: skip
    if (kind := str(fields.get("RecordingType", "")).lower()) in RECORDING_TYPES:
        kept["RecordingType"] = kind
    if parameters := fields.get("ElectricalStimulationParameters"):
        kept["ElectricalStimulationParameters"] = render(parse(str(parameters)))
    if any("notch" in json.dumps(fields.get(name, "")).lower() for name in ("SoftwareFilters", "HardwareFilters")):
        kept["SoftwareFilters"] = "notch"
    return json.dumps(kept, sort_keys=True)


def _start(files: Files, run: Run) -> str:
    """Find the time of the run in scans.tsv; empty where it has none."""
    name = PurePosixPath(run.data.path).name
    for row in read_tsv(files, run.scans):
        if PurePosixPath(row.get("filename", "")).name == name and TIME.fullmatch(row.get("acq_time", "")):
            return row["acq_time"]
    return ""
