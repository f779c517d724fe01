"""Search filters of the audit trail."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError
from sqlalchemy import Column, ColumnElement, Integer, Select, Table, and_, case, cast, false, func, or_, select, true
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import QueryableAttribute, aliased

from app.accounts.permissions import READ_AUDIT, Caller
from app.platform.audit import AUDITED
from app.platform.database import Base
from app.platform.web.schemas import Model, Text
from app.tables.accounts import Site
from app.tables.audit import AuditEvent

ACTION_WORDS = {
    "insert": "added wrote down stored", "update": "changed corrected", "delete": "removed", "view": "looked viewed",
    "export": "exported took", "download": "printed downloaded", "refuse": "refused",
}  # fmt: skip
"""What sentences say of an action; a search finds rows by these words too."""
SHOWN_NAMES = {
    "qoc": "outcomes", "buffer_snapshot": "snapshot", "buffer_gate_decision": "learning from tested policies", "app_user": "account",
    "api_token": "token", "session_proposal": "proposed session", "job": "job",
}  # fmt: skip
"""Tables that pages call otherwise than the database."""


@dataclass(frozen=True)
class Kind:
    """Acts that are searched together: by their action, or as a new row of a table."""

    said: str
    actions: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()


KINDS = {
    "changes": Kind("changes of rows", ("insert", "update", "delete")),
    "removals": Kind("removals", ("delete",)),
    "views": Kind("looks at results", ("view",)),
    "exports": Kind("exports, prints and bundles", ("export", "download"), ("bundle_release",)),
    "refusals": Kind("refused sign-ins", ("refuse",)),
    "signatures": Kind("signatures", (), ("signature",)),
}


class TrailFilter(Model):
    """Filter of the trail; an empty field matches all."""

    words: Text = Field("", max_length=200, description="Each must be in the sentence or in a value.")
    participant: Text = Field("", max_length=40, description="Code.")
    action: Text = Field("", max_length=20)
    entity: Text = Field("", max_length=63)
    entity_id: Text = Field("", max_length=200)
    actor: Text = Field("", max_length=254)
    begin: dt.date | None = Field(None, description="First day, UTC.")
    end: dt.date | None = Field(None, description="Last day, UTC.")

    @model_validator(mode="after")
    def _known(self) -> TrailFilter:
        if self.action and self.action not in KINDS:
            raise PydanticCustomError("kind", "there is no such kind of act")
        if self.begin and self.end and self.end < self.begin:
            raise PydanticCustomError("days", "the last day is before the first")
        if len(self.words.split()) > MOST_WORDS:
            raise PydanticCustomError("words", "too many words to look for at once")
        return self

    def stated(self) -> dict[str, str]:
        """Return the fields that are not empty, by name."""
        return {name: str(value) for name, value in self.model_dump().items() if value not in ("", None)}


MOST_WORDS = 8
"""Each word is a look through the whole trail."""


# Rows of the audit trail in a reader's studies and sites, or of a participant: by the foreign keys of the rows concerned.

_ROOTS = ("participant", "site", "study")
_SIGNED = ("plan", "policy", "visit_lock", "margins_lock", "declared_confirmation")
"""Tables whose rows are signed; a signature names them by kind."""
_REMOVED = ("visit", "session", "plan")
"""Tables with rows below them of which the service removes some: empty visits, discarded proposals, drafts."""
_ROW_CHANGES = ("insert", "update", "delete")
_NUMBER = r"^[0-9]{1,9}$"


def of_reader(caller: Caller) -> ColumnElement[bool]:
    """Build the condition on `AuditEvent`: rows of the studies and sites in which the caller reads the trail.

    Rows of accounts, sign-ins, tokens and stored files belong to no study and are excluded. So are refused sign-ins, and looks at results
    of several participants. A row that was moved counts where both its old and its new place do.
    """
    grants = caller.grants_with(READ_AUDIT)
    allowed = [(Site.study_id == g.study_id) & (Site.id == g.site_id if g.site_id else true()) for g in grants]
    sites = select(Site.id).where(or_(false(), *allowed))
    return _within(_Scope(sites, sorted({g.study_id for g in grants if g.site_id is None})), and_)


def of_participants(numbers: Sequence[int]) -> ColumnElement[bool]:
    """Build the condition on `AuditEvent`: rows of these participants and all that is theirs; moved rows count for both."""
    participant = Base.metadata.tables["participant"]
    return _within(_Scope(select(participant.c.site_id).where(false()), (), participant.c.id.in_(list(numbers))), or_)


def _within(scope: _Scope, joined: Callable[..., ColumnElement[bool]]) -> ColumnElement[bool]:
    changed = case(
        {name: joined(scope.told(name, AuditEvent.after, AuditEvent.before), scope.told(name, AuditEvent.before, AuditEvent.after))
         for name in AUDITED if name in scope.tables},
        value=AuditEvent.entity,
        else_=false(),
    )  # fmt: skip
    return case((AuditEvent.action.in_(_ROW_CHANGES), changed), else_=scope.recorded())


class _Scope:
    """Sites and studies, or participants alone, and conditions that lead to them.

    Args:
        sites: their numbers. studies: whose own rows belong to it. participants: condition on the table, by its site by default.
    """

    def __init__(self, sites: Select[int], studies: Sequence[int], participants: ColumnElement[bool] | None = None) -> None:
        self._sites, self._studies = sites, studies
        table = Base.metadata.tables["participant"]
        self._participants = select(table.c.id).where(table.c.site_id.in_(sites) if participants is None else participants)
        self._codes = select(table.c.code).where(table.c.id.in_(self._participants))
        self.tables = {name for name in AUDITED if name == "signature" or _leads_to_root(Base.metadata.tables[name])}

    def told(self, name: str, first: QueryableAttribute[Any], second: QueryableAttribute[Any]) -> ColumnElement[bool]:
        """Build the condition that a change of a row of a table is in scope, by the row as recorded."""
        row = cast(func.coalesce(first, second), JSONB)
        if name == "signature":
            number = row["subject_id"].as_integer()
            return case({kind: self._inside(kind, number) for kind in _SIGNED}, value=row["subject_kind"].as_string(), else_=false())
        if name in _ROOTS:
            return self._inside(name, row["id"].as_integer())
        key = _key(Base.metadata.tables[name])
        assert key is not None
        # A row outlasts what its key named where that was deleted. The key is then empty, and its earlier value says whose row it is
        named = (cast(side, JSONB)[key.name].as_integer() for side in (first, second))
        return self._inside(_parent(key), func.coalesce(*named))

    def recorded(self) -> ColumnElement[bool]:
        """Build the condition that an event without a changed row is in scope: exports, downloads, looks at one participant's results."""
        number = case((AuditEvent.entity_id.regexp_match(_NUMBER), cast(AuditEvent.entity_id, Integer)), else_=None)
        code = func.substring(AuditEvent.entity_id, "/participants/([^/?]+)")
        by_code = code.in_(self._codes)
        named = {name: self._inside(name, number) for name in ("participant", "session", "plan", "visit", "policy", "sweep", "upload_file")}
        return case(named | {"results": by_code}, value=AuditEvent.entity, else_=false())

    def _inside(self, name: str, number: ColumnElement[int], removed: bool = True) -> ColumnElement[bool]:
        """Build the condition that the row of a table with this number belongs to the reader's sites.

        `removed`: it may be deleted since, and is then looked up in the trail's own row of its removal. What a present row names still
        exists.
        """
        if name == "site":
            return number.in_(self._sites)
        if name == "study":
            return number.in_(self._studies)
        if name == "participant":
            return number.in_(self._participants)
        table = Base.metadata.tables[name]
        key = _key(table)
        assert key is not None
        present = number.in_(select(table.c.id).where(self._inside(_parent(key), key, removed=False)))
        if not removed or name not in _REMOVED:
            return present
        gone = aliased(AuditEvent)
        last = cast(gone.before, JSONB)[key.name].as_integer()
        removals = select(cast(gone.entity_id, Integer)).where(
            gone.entity == name, gone.action == "delete", self._inside(_parent(key), last)
        )
        return or_(present, number.in_(removals))


def _leads_to_root(table: Table) -> bool:
    return table.name in _ROOTS or _key(table) is not None


def _key(table: Table) -> Column[int] | None:
    """Find the foreign key that leads from a table to a participant, site or study over the fewest others; None where none does."""
    found = min(((length, name) for name, length in _lengths(table)), default=None)
    return None if found is None else table.c[found[1]]


def _lengths(table: Table, seen: frozenset[str] = frozenset()) -> list[tuple[str, int]]:
    """List (column, keys up to a root) of each foreign key by number that leads to a root; an optional key counts as longer."""
    found = []
    for key in table.foreign_keys:
        parent = key.column.table
        if not isinstance(key.parent.type, Integer) or parent.name in seen | {table.name}:
            continue
        own = 10 if key.parent.nullable else 1
        if parent.name in _ROOTS:
            found.append((key.parent.name, own))
        elif further := _lengths(parent, seen | {table.name}):
            found.append((key.parent.name, own + min(length for _, length in further)))
    return found


def _parent(key: Column[int]) -> str:
    (foreign,) = key.foreign_keys
    return str(foreign.column.table.name)
