"""Names of the rows in the audit trail, by their numbers."""

from __future__ import annotations

import datetime as dt
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import ColumnElement, Select, Text, and_, cast, false, func, not_, or_, select
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import QueryableAttribute, Session

from app.overview.trail_scope import ACTION_WORDS, KINDS, SHOWN_NAMES, TrailFilter, of_participants
from app.platform.audit import AUDITED
from app.platform.database import Base
from app.tables.audit import AuditEvent
from app.tables.participants import Participant
from app.tables.plans import SEALED, BundleRelease, Plan, PlanItem
from app.tables.sessions import StudySession
from app.tables.visits import Visit

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Names:
    """Names of the rows that changes are about, by their numbers.

    Attributes:
        participants: code. visits: number and participant. sessions: ordinal and visit. plans: visit. policies: name and participant.
        items: position and plan. events: participant and visit. queries: participant and what is asked about, in words. locks: visit.
        margins_locks: participant. confirmations: policy. people: address. studies: code. sites: code. sweeps: name and participant.
        snapshots: participant.
    """

    participants: Mapping[int, str] = field(default_factory=dict)
    visits: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    sessions: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    plans: Mapping[int, int] = field(default_factory=dict)
    policies: Mapping[int, tuple[str, int]] = field(default_factory=dict)
    items: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    events: Mapping[int, tuple[int, int | None]] = field(default_factory=dict)
    queries: Mapping[int, Row] = field(default_factory=dict)
    locks: Mapping[int, int] = field(default_factory=dict)
    margins_locks: Mapping[int, int] = field(default_factory=dict)
    confirmations: Mapping[int, int] = field(default_factory=dict)
    people: Mapping[int, str] = field(default_factory=dict)
    studies: Mapping[int, str] = field(default_factory=dict)
    sites: Mapping[int, str] = field(default_factory=dict)
    sweeps: Mapping[int, tuple[str, int]] = field(default_factory=dict)
    snapshots: Mapping[int, int] = field(default_factory=dict)

    def participant(self, number: int | None) -> str:
        """Return a participant's code."""
        return self.participants.get(number or 0, f"participant {number}")

    def visit(self, number: int | None) -> str:
        """Name a visit with its participant."""
        if number is None or number not in self.visits:
            return f"a visit that is gone ({number})"
        ordinal, participant = self.visits[number]
        return f"visit {ordinal} of {self.participant(participant)}"

    def session(self, number: int | None, row: Row | None = None) -> str:
        """Name a session with its visit; `row` where the session may be gone."""
        place = self.sessions.get(number or 0) or ((row["ordinal"], row["visit_id"]) if row and "visit_id" in row else None)
        return f"session {place[0]} of {self.visit(place[1])}" if place else f"session {number}"

    def policy(self, number: int) -> str:
        """Name a policy with its participant."""
        name, participant = self.policies.get(number, (f"policy {number}", None))
        return f"policy {name} of {self.participant(participant)}" if participant is not None else name

    def plan(self, number: int) -> str:
        """Name a plan with its visit."""
        visit = self.plans.get(number)
        return f"plan {number}" + (f" for {self.visit(visit)}" if visit is not None else "")

    def slot(self, number: int | None, plan: int) -> str:
        """Name a planned session with its plan; the plan alone where none is named."""
        item = self.items.get(number or 0)
        return f"session {item[0]} of {self.plan(item[1])}" if item else self.plan(plan)

    def event(self, number: int) -> str:
        """Name the participant of an adverse event, and the visit."""
        participant, visit = self.events.get(number, (None, None))
        return self.at(participant, visit)

    def at(self, participant: int | None, visit: int | None) -> str:
        """Name a participant, at a visit where one is named."""
        known = self.visits.get(visit or 0)
        return self.participant(participant) + (f" at visit {known[0]}" if known else "")

    def sweep(self, number: int) -> str:
        """Name a sweep with its participant."""
        name, participant = self.sweeps.get(number, (f"sweep {number}", None))
        return f"{name} of {self.participant(participant)}" if participant is not None else name

    def person(self, number: int | None) -> str:
        """Return a person's address."""
        return self.people.get(number or 0, f"account {number}")

    def place(self, study: int | None, site: int | None) -> str:
        """Name a study, and a site of it where one is named."""
        which = f"study {self.studies.get(study or 0, study)}"
        return which if site is None else f"{which}, site {self.sites.get(site, site)}"


# Queries of the audit trail: the rows that a reader asks for, names of their subjects, and which of them hide what ran.

_BATCH = 500
_SEALED_BY = {"session": "visit_id", "plan_item": "plan_id", "session_proposal": "session_id", "session_conditions": "session_id",
              "bundle_release": "plan_item_id", "stored_file": "sha256", "plan": "id", "adverse_event": "visit_id"}  # fmt: skip
"""Tables whose rows would reveal what ran under a sealed key, and the column by which they belong to a visit, plan, session, or file."""


def audit_events(
    db: Session, within: ColumnElement[bool], wanted: TrailFilter, limit: int, offset: int
) -> tuple[Sequence[AuditEvent], int]:
    """Load a page of the audit trail, newest first, and how many rows match. `within`: rows that may be read."""
    query = _matching(db, within, wanted)
    rows = db.scalars(query.order_by(AuditEvent.id.desc()).limit(limit).offset(offset)).all()
    if (rows and len(rows) < limit) or (not rows and offset == 0):
        return rows, offset + len(rows)  # all of them were seen: they need not be looked for again to be counted
    return rows, db.scalar(select(func.count()).select_from(query.subquery())) or 0


def batches(db: Session, within: ColumnElement[bool], wanted: TrailFilter) -> Iterator[Sequence[AuditEvent]]:
    """Yield all rows that match, newest first, some hundred at a time: those that are in the trail when the first are read."""
    query = _matching(db, within, wanted)
    last: int | None = None
    while True:
        below = query if last is None else query.where(AuditEvent.id < last)
        rows = db.scalars(below.order_by(AuditEvent.id.desc()).limit(_BATCH)).all()
        if not rows:
            return
        last = rows[-1].id
        yield rows


def audit_names(db: Session, events: Sequence[AuditEvent]) -> Names:
    """Load names of the rows that these events are about, in a query per kind of row."""
    rows = [(e.entity, row) for e in events for row in (e.before, e.after) if row]
    noted = [(e.entity, int(e.entity_id)) for e in events if e.action not in ("insert", "update", "delete") and e.entity_id.isdecimal()]
    signed = [(row["subject_kind"], row["subject_id"]) for name, row in rows if name == "signature"]

    def numbers(entity: str, *columns: str) -> set[int]:
        own = {int(r["id"]) for name, r in rows if name == entity and "id" in r} | {n for name, n in (*noted, *signed) if name == entity}
        return own | {int(r[c]) for _, r in rows for c in columns if r.get(c) is not None and str(r[c]).isdecimal()}

    def read(name: str, wanted: Collection[int], *columns: str) -> dict[int, tuple[Any, ...]]:
        """Read those of the table's rows that still exist."""
        if not wanted:
            return {}
        table = Base.metadata.tables[name]
        found = db.execute(select(table.c.id, *(table.c[c] for c in columns)).where(table.c.id.in_(wanted)))
        return {row[0]: tuple(row[1:]) for row in found}

    queries = read("data_query", numbers("data_query", "query_id"), *_QUERY)
    asked = {i: dict(zip(_QUERY, row, strict=True)) for i, row in queries.items()}
    of_queries = {q["event_id"] for q in asked.values() if q["event_id"]}
    events_ = read("adverse_event", numbers("adverse_event", "event_id") | of_queries, "participant_id", "visit_id")
    of_queries = {q["session_id"] for q in asked.values() if q["session_id"]}
    sessions = read("session", numbers("session", "session_id") | of_queries, "ordinal", "visit_id")
    items = read("plan_item", numbers("plan_item", "plan_item_id"), "position", "plan_id")
    plans = read("plan", numbers("plan", "plan_id") | {plan for _, plan in items.values()}, "visit_id")
    locks = read("visit_lock", numbers("visit_lock"), "visit_id")
    margins = read("margins_lock", numbers("margins_lock"), "participant_id")
    snapshots = read("buffer_snapshot", numbers("buffer_snapshot", "snapshot_id"), "participant_id")
    sweeps = read("sweep", numbers("sweep", "sweep_id"), "name", "participant_id")
    paths = [e.entity_id.split("/policies/")[1].split("/")[0] for e in events if e.entity == "results" and "/policies/" in e.entity_id]
    declared = read("declared_confirmation", numbers("declared_confirmation"), "policy_id")
    paths += [str(i) for (i,) in declared.values()]
    policies = read("policy", numbers("policy", "policy_id") | {int(n) for n in paths if n.isdecimal()}, "name", "participant_id")
    of_visits = {v for _, v in sessions.values()} | {v for (v,) in (*plans.values(), *locks.values())}
    of_visits |= {v for _, v in events_.values() if v is not None} | {q["visit_id"] for q in asked.values() if q["visit_id"]}
    visits = read("visit", numbers("visit", "visit_id") | of_visits, "number", "participant_id")
    whose = {p for _, p in (*visits.values(), *policies.values(), *sweeps.values())} | {
        p for (p,) in (*margins.values(), *snapshots.values())
    }
    whose |= {p for p, _ in events_.values()} | {q["participant_id"] for q in asked.values()}
    sites = read("site", numbers("site", "site_id"), "code", "study_id")
    studies = read("study", numbers("study", "study_id"), "code")
    return Names(
        participants=_first(read("participant", numbers("participant", "participant_id") | whose, "code")),
        visits=visits,
        sessions=sessions,
        plans=_first(plans),
        policies=policies,
        items=items,
        events=events_,
        queries=asked,
        locks=_first(locks),
        margins_locks=_first(margins),
        confirmations=_first(declared),
        people=_first(read("app_user", numbers("app_user", "user_id"), "email")),
        studies=_first(studies),
        sites=_first(sites),
        sweeps=sweeps,
        snapshots=_first(snapshots),
    )


def sealed_events(db: Session, events: Sequence[AuditEvent]) -> frozenset[int]:
    """Find events about a blinded plan whose key is sealed: of the plan, its rows, its bundles' files, or sessions of its visit."""
    hidden = hidden_rows(db)
    if hidden is None or not events:
        return frozenset()
    return frozenset(db.scalars(select(AuditEvent.id).where(AuditEvent.id.in_([e.id for e in events]), hidden)))


def hidden_rows(db: Session) -> ColumnElement[bool] | None:
    """Build the condition on `AuditEvent` for rows that would reveal what ran at a visit whose key is sealed; None while no key is."""
    plans = set(db.scalars(select(Plan.id).where(SEALED)))
    if not plans:
        return None
    items = select(PlanItem.id).where(PlanItem.plan_id.in_(plans))
    visits = list(db.scalars(select(Visit.id).where(Visit.sealed)))
    open_to_all = select(StudySession.id).where(StudySession.visit_id.not_in(visits))
    files = select(BundleRelease.sha256).where(BundleRelease.plan_item_id.in_(items))

    def tells(entity: str, row: ColumnElement[Any]) -> ColumnElement[bool]:
        value = row[_SEALED_BY[entity]]
        if entity == "stored_file":
            known: ColumnElement[bool] = value.as_string().in_(files)
            return known
        number: ColumnElement[int] = value.as_integer()
        if _SEALED_BY[entity] == "session_id":  # a proposal that is gone may have been of any visit
            return and_(number.is_not(None), number.not_in(open_to_all))
        if _SEALED_BY[entity] == "plan_item_id":
            return number.in_(items)
        return number.in_(visits if _SEALED_BY[entity] == "visit_id" else plans)

    told = [
        and_(AuditEvent.entity == entity, func.coalesce(tells(entity, cast(row, JSONB)), false()))
        for entity in _SEALED_BY
        for row in (AuditEvent.before, AuditEvent.after)
    ]
    return or_(*told)


_QUERY = ("participant_id", "session_id", "upload_id", "visit_id", "dose_id", "event_id", "record", "field")


def _first(rows: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
    return {i: row[0] for i, row in rows.items()}


def _matching(db: Session, within: ColumnElement[bool], wanted: TrailFilter) -> Select[AuditEvent]:
    """Query the rows of a filter. Values that are hidden from every reader are not searched either: a hit would reveal them."""
    query: Select[AuditEvent] = select(AuditEvent).where(within)
    for column, value in (
        (AuditEvent.entity, wanted.entity),
        (AuditEvent.entity_id, wanted.entity_id),
        (AuditEvent.actor, wanted.actor.strip().lower()),
    ):
        if value:
            query = query.where(column == value)
    if wanted.action:
        query = query.where(_of_kind(wanted.action))
    if wanted.begin is not None:
        query = query.where(AuditEvent.at >= _midnight(wanted.begin))
    if wanted.end is not None:
        query = query.where(AuditEvent.at < _midnight(wanted.end) + dt.timedelta(days=1))
    if code := wanted.participant.strip().lower():
        query = query.where(of_participants(db.scalars(select(Participant.id).where(func.lower(Participant.code) == code)).all()))
    words = wanted.words.split()
    hidden = hidden_rows(db) if words else None
    for word in words:
        query = query.where(_mentions(db, word, hidden))
    return query


def _of_kind(name: str) -> ColumnElement[bool]:
    kind = KINDS[name]
    return or_(false(), AuditEvent.action.in_(kind.actions), and_(AuditEvent.entity.in_(kind.tables), AuditEvent.action == "insert"))


def _midnight(day: dt.date) -> dt.datetime:
    return dt.datetime.combine(day, dt.time(), dt.UTC)


def _mentions(db: Session, word: str, hidden: ColumnElement[bool] | None) -> ColumnElement[bool]:
    """Build the condition that a row's sentence, or a value of it, has a word."""

    def holds(value: ColumnElement[Any] | QueryableAttribute[Any]) -> ColumnElement[bool]:
        return func.coalesce(value.icontains(word, autoescape=True), false())

    def has_value(row: QueryableAttribute[Any]) -> ColumnElement[bool]:
        """Search values only: names of columns are none, else every row of a session would be found by "visit"."""
        value = func.jsonb_each_text(cast(row, JSONB)).table_valued("key", "value")
        return select(value.c.key).where(value.c.value.icontains(word, autoescape=True)).exists()

    low = word.lower()
    tables = [name for name in AUDITED if low in SHOWN_NAMES.get(name, name.replace("_", " ")) or low in name]
    actions = [action for action, said in ACTION_WORDS.items() if low in said]
    values = or_(holds(AuditEvent.reason), has_value(AuditEvent.before), has_value(AuditEvent.after))
    named = db.scalars(select(Participant.id).where(Participant.code.icontains(word, autoescape=True))).all()
    exactly = or_(holds(AuditEvent.actor), holds(AuditEvent.entity_id), values if hidden is None else and_(not_(hidden), values))
    e = AuditEvent
    whole = func.concat_ws(" ", e.actor, e.entity_id, e.reason, cast(e.before, Text), cast(e.after, Text))  # one look before the exact ones
    return or_(e.entity.in_(tables), e.action.in_(actions), of_participants(named) if named else false(), and_(holds(whole), exactly))
