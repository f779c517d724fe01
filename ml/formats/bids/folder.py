"""Runs of a BIDS folder and the files that describe them, by the inheritance principle. Source: BIDS 1.10, iEEG."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import IO, Any

from ml.formats.archive import Files, LeftOut
from ml.formats.recording import FileReport, UndecodableFile

KINDS = {".edf": "edf", ".bdf": "edf", ".vhdr": "brainvision", ".nwb": "nwb"}
"""Format of a data file by its ending."""
NOT_READ = (".set", ".mefd")
ASIDE = frozenset({"derivatives", "sourcedata", "code", "stimuli", "phenotype"})
HINT = "Zip the folder of one participant with the data files (EDF, BrainVision or NWB), their sidecars, and scans.tsv."
LARGEST_TEXT = 64 << 20
LARGEST_JSON = 1 << 20
MOST_ROWS = 200_000
_NAME = re.compile(r"((?:[a-zA-Z0-9]+-[a-zA-Z0-9]+_)*)([a-zA-Z0-9]+)(\.[a-zA-Z0-9]+)")
_IEEG = re.compile(r"(?:^|/)[a-zA-Z]+-[^/]*_ieeg\.[a-z]+(?:$|/)")


@dataclass(frozen=True, slots=True)
class Named:
    """A file by its name: folder, entities such as (`run`, `01`), suffix and ending."""

    path: str
    folder: PurePosixPath
    entities: frozenset[tuple[str, str]]
    suffix: str
    ending: str

    def describes(self, data: Named) -> bool:
        """Decide whether it applies to a data file: it is in its folder or above, and has no entity that the data file lacks."""
        above = self.folder == data.folder or self.folder in data.folder.parents
        return above and {e for e in self.entities if e[0] != "space"} <= data.entities


@dataclass(frozen=True, slots=True)
class Run:
    """One data file and the files that describe it, the nearest last.

    Attributes:
        data: its name, of a header for BrainVision. kind: of its format. sidecars: JSON. event_heads: JSON that describes columns.
        channels, electrodes, events, scans: tables; None where there is none.
    """

    data: Named
    kind: str
    sidecars: tuple[str, ...]
    event_heads: tuple[str, ...]
    channels: str | None
    electrodes: str | None
    events: str | None
    scans: str | None


@dataclass(slots=True)
class View:
    """Some files of an archive, as an archive of their own."""

    files: Files
    chosen: list[str]
    left_out: list[LeftOut] = field(default_factory=list)

    def names(self) -> list[str]:
        """List names in sorted order."""
        return sorted(self.chosen)

    def open(self, name: str) -> IO[bytes]:
        """Open the file's bytes as a stream."""
        return self.files.open(name)


def holds_folder(files: Files, report: FileReport) -> bool:
    """Decide whether an archive has a file of a BIDS recording within the brain."""
    return any(_IEEG.search(name) for name in files.names())


def find_runs(files: Files) -> tuple[list[Run], list[str]]:
    """Find the runs of one participant, in the order of their names, and sentences on what is no run.

    Raises:
        UndecodableFile: no data file, or those of two participants.
    """
    names = _names(files)
    data = [n for n in names if n.suffix == "ieeg" and n.ending in KINDS]
    unread = {f"{n.folder}/{n.path}" for n in names if n.suffix == "ieeg" and n.ending == ".set"}
    unread |= {name.split(".mefd/")[0] for name in files.names() if ".mefd/" in name}
    sentences = [f"{len(unread)} runs in EEGLAB or MEF3 files, which are not read: export them as EDF+ or BrainVision"] if unread else []
    if not data:
        what = "no data file of a run in here" + (", but in a format that is not read" if unread else ": its sidecars alone")
        raise UndecodableFile(what, "sub-…_ieeg", HINT)
    if (people := len({dict(n.entities).get("sub", "") for n in data})) > 1:
        raise UndecodableFile(f"the folder has recordings of {people} participants", "sub-…", f"Upload them one by one. {HINT}")
    runs = [_run(one, names) for one in data]
    used = {path for run in runs for path in (*run.sidecars, *run.event_heads, run.channels, run.events)}
    orphans = {
        n.entities for n in names if n.suffix in ("ieeg", "channels", "events") and n.ending in (".json", ".tsv") and n.path not in used
    }
    orphans = {e for e in orphans if "task" in dict(e) and "sub" in dict(e)}
    if orphans and not unread:
        sentences.append(f"{len(orphans)} runs have sidecars and no data file: nothing of them was read. Were they left out of the zip?")
    return runs, sentences


def _names(files: Files) -> list[Named]:
    """List the files with names of BIDS, without folders that hold no raw data."""
    out = []
    for path in files.names():
        folder, name = PurePosixPath(path).parent, PurePosixPath(path).name
        found = _NAME.fullmatch(name)
        if found and not ASIDE & set(folder.parts):
            entities = frozenset((key, value) for key, _, value in (e.partition("-") for e in found[1].split("_") if e))
            out.append(Named(path, folder, entities, found[2], found[3].lower()))
    return sorted(out, key=lambda n: n.path)


def _run(data: Named, names: Iterable[Named]) -> Run:
    fitting = sorted((n for n in names if n.describes(data)), key=lambda n: (len(n.folder.parts), len(n.entities)))

    def all_of(suffix: str, ending: str) -> tuple[str, ...]:
        return tuple(n.path for n in fitting if n.suffix == suffix and n.ending == ending)

    tables = {suffix: (None, *all_of(suffix, ".tsv"))[-1] for suffix in ("channels", "electrodes", "events", "scans")}
    return Run(data, KINDS[data.ending], all_of("ieeg", ".json"), all_of("events", ".json"), **tables)


def members_of(run: Run, files: Files) -> View:
    """List the files of a run's data: one, or those of a BrainVision recording."""
    if run.kind != "brainvision":
        return View(files, [run.data.path])
    stem = run.data.path.removesuffix(PurePosixPath(run.data.path).suffix)
    return View(
        files, [n for n in files.names() if PurePosixPath(n).suffix.lower() in (".vhdr", ".vmrk", ".eeg") and n.startswith(f"{stem}.")]
    )


def read_json(files: Files, names: Iterable[str]) -> dict[str, Any]:
    """Read JSON files, of which a later one goes before. Raises UndecodableFile where one is no object."""
    out: dict[str, Any] = {}
    for name in names:
        with files.open(name) as stream:
            raw = stream.read(LARGEST_JSON + 1)
        try:
            found = json.loads(raw.decode("utf-8-sig")) if len(raw) <= LARGEST_JSON else None
        except ValueError:
            found = None
        if not isinstance(found, dict):
            raise UndecodableFile("a sidecar is no JSON object", PurePosixPath(name).name, "Correct it.", None, "a sidecar (.json)")
        out |= found
    return out


def read_tsv(files: Files, name: str | None) -> list[dict[str, str]]:
    """Read the rows of a table by their headers; none where there is no table. Raises UndecodableFile where a row is too short."""
    if name is None:
        return []
    with files.open(name) as stream:
        raw = stream.read(LARGEST_TEXT)
    lines = raw.decode("utf-8-sig", "replace").splitlines()
    heads = [h.strip() for h in lines[0].split("\t")] if lines else []
    out = []
    for number, line in enumerate(lines[1 : MOST_ROWS + 1], start=2):
        if not line.strip():
            continue
        cells = line.split("\t")
        if len(cells) != len(heads):
            what = f"line {number} has {len(cells)} cells for {len(heads)} columns"
            where = PurePosixPath(name).name
            raise UndecodableFile(what, where, "Separate the cells by tabs.", None, f"a table of {name.rsplit('_', 1)[-1]}")
        out.append({head: cell.strip() for head, cell in zip(heads, cells, strict=True)})
    return out
