"""Record of a kind of table that holds measurements of one outcome; `outcome_tables` lists the kinds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, OutcomeLog
from ml.formats.source import Source
from ml.formats.tables.cells.delimited import TextTable


class MappedCells(Protocol):
    """Writer of a table that a column mapping reads, with the names and cells that its decoder knows."""

    def __call__(
        self, table: TextTable, places: Mapping[str, int], t_s: NDArray[np.float64], absolute: bool
    ) -> tuple[list[str], list[list[str]]]:
        """Return the names of columns, and the cells of each row.

        Args:
            places: of the mapped columns by role, from 0; without the time. t_s: the time of each row, s.
            absolute: True where times are Unix time.

        Raises:
            UndecodableFile: text for a number.
        """


@dataclass(frozen=True, kw_only=True)
class OutcomeTable:
    """A kind of table of one outcome.

    Attributes:
        kind: of its files. name: of the kind, in words. holds: its rows, in words.
        log: type of its decoded measurements. roles: of columns that a column mapping may name, besides the time.
        recognises: decides by the headers of a table. decode: reads one. lines: writes decoded measurements without identity.
        mapped_cells: writes a table that a column mapping reads.
    """

    kind: str
    name: str
    holds: str
    log: type[OutcomeLog]
    roles: tuple[str, ...]
    recognises: Callable[[Sequence[str]], bool]
    decode: Callable[[Source, DecodeOptions | None, str | None], DecodedFile]
    lines: Callable[[Sequence[Any]], list[str]]
    mapped_cells: MappedCells


def cell(value: float) -> str:
    """Write a number so that it is read back as it is; empty for NaN."""
    return "" if value != value else repr(float(value))
