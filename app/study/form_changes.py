"""What a person changed of what a form showed, so that an old form takes back nothing that it did not touch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from app.platform.errors import Conflict


@dataclass(frozen=True)
class Shown:
    """What a form shows of one revision.

    Attributes:
        number: of the revision.
        fields: field name to text.
        author: who made the revision.
    """

    number: int
    fields: Mapping[str, str]
    author: str


@dataclass(frozen=True)
class OwnChanges:
    """What a person changed of what the form showed.

    Attributes:
        fields: field name to typed text, where it differs from what the form showed and from what is stored now.
        conflicts: of those, the ones that somebody else changed after the form was opened: `where` and `what`.
    """

    fields: dict[str, str]
    conflicts: list[dict[str, str]]

    def refuse_conflicts(self) -> None:
        """Raises Conflict where two people changed the same field."""
        if self.conflicts:
            raise Conflict(
                "Somebody else changed the same values after this form was opened; nothing was saved.",
                "What you typed still stands in the form: save again to replace what is stored, or load the page again to keep it.",
                errors=self.conflicts,
            )


def own_changes(values: Mapping[str, Any], seen: str | None, revisions: Sequence[Shown], labels: Mapping[str, str]) -> OwnChanges:
    """Compare a posted form with the revision that it showed, so that an old form takes back nothing that it did not touch.

    Args:
        values: the posted form; a field that it does not have is not changed.
        seen: number of the revision that the form showed; None for a post that names none: it is held against the newest one.
            A number that does not exist makes every change a conflict.
        revisions: all of them, oldest first.
        labels: names of the fields as the page shows them.
    """
    present = revisions[-1]
    known = present if seen is None else next((r for r in revisions if str(r.number) == seen.strip()), None)
    fields, conflicts = {}, []
    for name, stored in present.fields.items():
        typed = str(values.get(name, stored)).strip()
        shown = known.fields[name].strip() if known else None
        if typed in (shown, stored.strip()):
            continue
        fields[name] = typed
        if shown != stored.strip():
            author = next((b.author for a, b in reversed(list(pairwise(revisions))) if a.fields[name] != b.fields[name]), present.author)
            what = f"stored now: {stored or 'no value'}, by {author}; you typed: {typed or 'no value'}"
            conflicts.append({"where": labels.get(name, name), "what": what})
    return OwnChanges(fields, conflicts)


def reason_of(values: Mapping[str, Any]) -> str | None:
    """The reason that a posted form gives, if any."""
    return str(values.get("reason", "")).strip()[:1000] or None
