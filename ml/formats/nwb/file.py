"""Safe access to an NWB file: no link out of the file is followed, and a dataset is checked before it is read.

HDF5 opens other files by itself: external links, external storage and virtual datasets name them by path. Nothing here does.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ml.formats.recording import UndecodableFile
from ml.formats.source import Source

SIGNATURE = b"\x89HDF\r\n\x1a\n"
HINT = "Send the NWB file as it was written, whole and alone."
ELSEWHERE = "Copy the samples into the file (pynwb: export it without links), then send that."
FILTERS = frozenset({1, 2, 3, 4, 6, 32000})
"""Numbers of filters that are read: gzip, shuffle, fletcher32, szip, scale and offset, lzf."""
MOST_BYTES = 4 << 30
"""Bytes that a dataset may have unpacked."""
MOST_TEXTS = 200_000
READ_ERRORS = (OSError, RuntimeError, KeyError, UnicodeDecodeError)
"""What h5py raises for damaged files."""
_CUT = re.compile(r"eof = (\d+).*?stored_eof = (\d+)")
_DEPTH = 16


class Elsewhere(UndecodableFile):
    """Samples that are in another file."""

    def __init__(self, place: str) -> None:
        super().__init__("its samples are in another file, which was not sent", place, ELSEWHERE, None, "a series of samples")


@contextmanager
def open_nwb(source: Source) -> Iterator[Any]:
    """Open an NWB 2 file. Raises UndecodableFile where it is cut, damaged, or another kind of HDF5."""
    try:
        import h5py  # an extra: a process that reads no NWB does not load it
    except ImportError as error:
        what = "the package h5py, which reads NWB files, is not installed"
        raise UndecodableFile(what, "service", "Ask your administrator to install betaloop[recordings].") from error
    with source.open("rb") as stream:
        try:
            file = h5py.File(source, "r", locking=False) if isinstance(source, Path) else h5py.File(stream, "r")
        except READ_ERRORS as error:
            sizes = _CUT.search(str(error))
            what = f"the file is cut: {sizes[1]} of {sizes[2]} bytes are there" if sizes else "the HDF5 file is cut or damaged"
            raise UndecodableFile(what, "file", f"Copy it again from where it was recorded. {HINT}") from error
        with file:
            if text(file.attrs.get("neurodata_type")) != "NWBFile":
                what = "this HDF5 file is none of NWB 2"
                raise UndecodableFile(what, "neurodata_type of the file", "Export the recording as NWB 2 (pynwb), EDF+ or XDF.")
            yield file


def child(group: Any, name: str, depth: int = 0) -> Any:
    """Return a member of a group; None where it is missing. Raises Elsewhere for a link to another file."""
    import h5py

    link = group.get(name, getlink=True)
    if isinstance(link, h5py.ExternalLink):
        raise Elsewhere(f"{group.name}/{name}")
    if isinstance(link, h5py.SoftLink):
        if depth > _DEPTH:
            return None
        found = group.file["/"] if link.path.startswith("/") else group
        for part in link.path.strip("/").split("/"):
            found = child(found, part, depth + 1) if isinstance(found, h5py.Group) and part else found
        return found
    return None if link is None else group[name]


def numbers(group: Any, name: str) -> Any:
    """Return a dataset of numbers, unread; None where it is missing, or has none. Raises UndecodableFile where it is not to be read."""
    found = child(group, name)
    if found is None or not hasattr(found, "dtype") or found.dtype.kind not in "iufb":
        return None
    check(found)
    return found


def check(dataset: Any) -> None:
    """Raise UndecodableFile for a dataset in another file, of an impossible size, or packed in a way that is not read."""
    if dataset.is_virtual or dataset.external:
        raise Elsewhere(dataset.name)
    if dataset.size is None or dataset.size * dataset.dtype.itemsize > MOST_BYTES:
        what = f"a dataset claims more than {MOST_BYTES >> 30} GiB"
        raise UndecodableFile(what, dataset.name, "Send one session per file.", None, "a dataset")
    made = dataset.id.get_create_plist()
    if not FILTERS.issuperset(made.get_filter(i)[0] for i in range(made.get_nfilters())):
        what = "a dataset is packed by a filter that is not read"
        raise UndecodableFile(what, dataset.name, "Write it with gzip, or unpacked.", None, "a dataset")


def texts(group: Any, name: str) -> list[str]:
    """Read a dataset of texts, or of one; empty where it is missing, or is none."""
    found = child(group, name)
    if found is None or not hasattr(found, "dtype") or found.dtype.kind not in "OSU":
        return []
    if found.is_virtual or found.external:
        raise Elsewhere(found.name)
    if found.size is None or found.size > MOST_TEXTS:
        return []
    return [text(value) for value in np.atleast_1d(found[()]).ravel().tolist()]


def text(value: Any) -> str:
    """Convert a value of a file to text; empty for anything else."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str) else ""


def number(value: Any, default: float) -> float:
    """Convert an attribute to a number; the default where it is missing. Raises UndecodableFile for one that is none."""
    if value is None:
        return default
    try:
        found = float(np.asarray(value).ravel()[0])
    except (TypeError, ValueError, IndexError) as error:
        raise UndecodableFile("an attribute has no number", "conversion, offset or rate of a series", HINT) from error
    if not np.isfinite(found):
        raise UndecodableFile("an attribute is no finite number", "conversion, offset or rate of a series", HINT)
    return found
