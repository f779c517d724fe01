"""Transfer of decoded data from the process that decoded a file to the one that stores it: JSON, and arrays next to it.

Nothing that is read here can run: no pickle, and no class but those of `recording` and of the outcomes' logs. The size is checked before
anything is loaded, for it follows from the file of a stranger.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats import recording
from ml.formats.recording import DecodedFile, UndecodableFile
from ml.formats.tables.outcome_tables import OUTCOME_TABLES

MOST_TEXT = 16 << 20
"""Bytes of JSON: some 50 000 events. The longest recordings at hand have some hundred."""
MOST_NUMBERS = 128 << 20
"""Bytes of arrays: 200 traces of the longest recording (`MAX_ROWS` of RC+S)."""
_TEXT, _NUMBERS, _KIND = "decoded.json", "arrays.npz", "$"
_LOGS = (*vars(recording).values(), *(one.log for one in OUTCOME_TABLES))
_CLASSES = {c.__name__: c for c in _LOGS if isinstance(c, type) and dataclasses.is_dataclass(c)}


def write(decoded: DecodedFile, folder: Path) -> None:
    """Write a decoded file into a folder.

    Raises:
        UndecodableFile: it is larger than any recording's.
        TypeError: it holds what no decoder gives.
    """
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_plain(decoded, arrays), separators=(",", ":"))
    if len(text) > MOST_TEXT or sum(a.nbytes for a in arrays) > MOST_NUMBERS:
        what = f"its content makes more than {MOST_TEXT >> 20} MiB of events and settings, or {MOST_NUMBERS >> 20} MiB of numbers"
        raise UndecodableFile(what, "file", "Upload one session per file.")
    (folder / _TEXT).write_text(text, encoding="ascii")
    np.savez(folder / _NUMBERS, allow_pickle=False, **{f"a{i}": a for i, a in enumerate(arrays)})


def read(folder: Path) -> DecodedFile:
    """Read the decoded file that `write` wrote. Raises ValueError where the folder has anything else."""
    text, numbers = folder / _TEXT, folder / _NUMBERS
    if text.stat().st_size > MOST_TEXT or numbers.stat().st_size > 2 * MOST_NUMBERS:
        raise ValueError("what the decoder left is larger than it may be")
    with np.load(numbers, allow_pickle=False) as arrays:
        found = _back(json.loads(text.read_bytes()), arrays)
    if not isinstance(found, DecodedFile):
        raise ValueError("the decoder left no decoded file")
    return found


def _plain(value: Any, arrays: list[NDArray[Any]]) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value.item() if isinstance(value, np.generic) else value
    if isinstance(value, np.generic):
        return _plain(value.item(), arrays)
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {_KIND: "array", "number": len(arrays) - 1}
    if isinstance(value, datetime):
        return {_KIND: "datetime", "iso": value.isoformat()}
    if isinstance(value, tuple):
        return {_KIND: "tuple", "items": [_plain(v, arrays) for v in value]}
    if isinstance(value, list):
        return [_plain(v, arrays) for v in value]
    if isinstance(value, Mapping):
        if all(isinstance(k, str) for k in value) and _KIND not in value:
            return {k: _plain(v, arrays) for k, v in value.items()}
        return {_KIND: "dict", "items": [[_plain(k, arrays), _plain(v, arrays)] for k, v in value.items()]}
    if type(value).__name__ in _CLASSES:
        fields = {f.name: _plain(getattr(value, f.name), arrays) for f in dataclasses.fields(value)}
        return {_KIND: type(value).__name__, "fields": fields}
    raise TypeError(f"a decoder gives no {type(value).__name__}")


def _back(value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    if isinstance(value, list):
        return [_back(v, arrays) for v in value]
    if not isinstance(value, dict):
        return value
    kind = value.get(_KIND)
    if kind is None:
        return {k: _back(v, arrays) for k, v in value.items()}
    if kind == "array":
        return arrays[f"a{value['number']}"]
    if kind == "datetime":
        return datetime.fromisoformat(value["iso"])
    if kind == "tuple":
        return tuple(_back(v, arrays) for v in value["items"])
    if kind == "dict":
        return {_back(k, arrays): _back(v, arrays) for k, v in value["items"]}
    if kind not in _CLASSES:
        raise ValueError(f"a decoder gives no {kind}")
    return _CLASSES[kind](**{name: _back(v, arrays) for name, v in value["fields"].items()})
