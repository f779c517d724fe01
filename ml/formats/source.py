"""Input of decoders: a file's bytes, wherever they are."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from typing import BinaryIO, Literal, Protocol


class Source(Protocol):
    """A file that can be opened as often as needed; `pathlib.Path` is one, and so is a file that its owner keeps encrypted."""

    @property
    def name(self) -> str:
        """Its last name, for reports that have no better one."""

    def open(self, mode: Literal["rb"]) -> BinaryIO:
        """Open its bytes from the first on; they can be sought in. Raises OSError."""


@dataclass(frozen=True)
class InMemory:
    """A file that is on no disk."""

    content: bytes = field(repr=False)
    name: str = "table"

    def open(self, mode: Literal["rb"] = "rb") -> BinaryIO:
        """Open the content from the first byte on."""
        return io.BytesIO(self.content)
