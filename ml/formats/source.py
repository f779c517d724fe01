"""What decoders read: a file's bytes, wherever they lie."""

from __future__ import annotations

from typing import BinaryIO, Literal, Protocol


class Source(Protocol):
    """A file that can be opened as often as needed; `pathlib.Path` is one, and so is a file that its owner keeps encrypted."""

    @property
    def name(self) -> str:
        """Its last name, for reports that have no better one."""

    def open(self, mode: Literal["rb"]) -> BinaryIO:
        """Its bytes from the first on; they can be sought in. Raises OSError."""
