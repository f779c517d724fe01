"""Loose files of one recording: a device writes several files, and they may come without their folder or archive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

MIXED = "the files of one folder name {} implants or sessions: each was taken as a recording of its own, for two are never mixed"


@dataclass(frozen=True)
class Opening:
    """The begin of a file.

    Attributes:
        stem: which file of a session it is, such as `RawDataTD`; None where its content does not show it.
        device, session: that it names first, in one spelling; None where there is none.
        empty: whether it holds no record at all, as the device writes what it did not record.
    """

    stem: str | None = None
    device: str | None = None
    session: str | None = None
    empty: bool = False

    @property
    def nameless(self) -> bool:
        """True where it names neither its implant nor its session."""
        return self.device is None and self.session is None


@dataclass(frozen=True)
class Groups:
    """Files that belong together, by their places in the list that was given.

    Attributes:
        recordings: one list per implant and session. homeless: empty files that could belong to any of several recordings.
    """

    recordings: list[list[int]]
    homeless: list[int]


@dataclass(frozen=True)
class LooseFiles:
    """Files of a format that are put together where they come loose.

    Attributes:
        name: of the files, for people.
        head: bytes of each file that are looked at.
        read: finds from a file's name and its first bytes which file of a recording it is. A `stem` of None: of no recording.
    """

    name: str
    head: int
    read: Callable[[str, bytes], Opening]


def group(openings: Sequence[Opening]) -> Groups:
    """Put together what names the same implant and session; two are never mixed.

    A file that names only one of them, or neither, goes to the only recording that it fits to. Where it fits to several it is a group of
    its own, or is homeless when it is empty.
    """
    named = [i for i, o in enumerate(openings) if not o.nameless]
    keys = sorted({(openings[i].device, openings[i].session) for i in named}, key=lambda k: (k[0] or "", k[1] or ""))
    whole = [k for k in keys if not _merges(k, keys)]
    members: dict[tuple[str | None, str | None], list[int]] = {k: [] for k in whole}
    alone: list[int] = []
    homeless: list[int] = []
    for i, opening in enumerate(openings):
        own = (opening.device, opening.session)
        fits = [own] if own in members else [k for k in whole if _fits(own, k)]
        if len(fits) == 1:
            members[fits[0]].append(i)
        elif opening.empty and len(whole) > 1:
            homeless.append(i)
        else:
            alone.append(i)
    return Groups([places for places in (*members.values(), alone) if places], homeless)


def _merges(key: tuple[str | None, str | None], keys: Sequence[tuple[str | None, str | None]]) -> bool:
    """Decide whether a key that leaves something open fits to exactly one that is more specific."""
    return sum(_fits(key, other) and other != key for other in keys) == 1


def _fits(part: tuple[str | None, str | None], whole: tuple[str | None, str | None]) -> bool:
    return all(a is None or a == b for a, b in zip(part, whole, strict=True))
