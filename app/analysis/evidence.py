"""Contribution of every session of a participant to the analyses, read at once and cached until one of its rows changes."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import cast, func, literal, select
from sqlalchemy.dialects.postgresql import JSONPATH
from sqlalchemy.orm import Session, contains_eager, defer, joinedload, selectinload

from app.accounts.permissions import Caller
from app.analysis.facts import Excluded, Facts, LeftOut, read, several_sides
from app.platform.errors import Invalid
from app.platform.kept import keep, recalled
from app.study import blinding
from app.study import repository as study
from app.study.adverse_events import late_stops
from app.study.sessions.repository import fingerprints, policy_shares
from app.study.sessions.usable_steps import failed_qoc_of
from app.tables.participants import Participant
from app.tables.recordings import Recording, Trace
from app.tables.sessions import SessionSegment, StudySession
from app.tables.visits import Visit
from ml.qoc import Qoc

# Queries of the evidence: which rows it rests on, in which version.

STIMULATION_EVENTS = '$.events[*] ? (@.kind == "stimulation")'


def sessions_of(db: Session, participant_ids: Collection[int]) -> dict[int, list[StudySession]]:
    """Load sessions and proposals by participant, visit and order, for many at once: without their conditions and recordings."""
    visit = contains_eager(StudySession.visit).options(
        joinedload(Visit.participant).joinedload(Participant.site), selectinload(Visit.locks), selectinload(Visit.cdbs_amplitudes)
    )
    query = (
        select(StudySession)
        .join(StudySession.visit)
        .where(Visit.participant_id.in_(participant_ids))
        .options(
            visit,
            selectinload(StudySession.qocs),
            selectinload(StudySession.segments),
        )
        .order_by(Visit.number, StudySession.ordinal)
        .execution_options(populate_existing=True)  # what was read before may be older than the key of what is kept
    )
    found: dict[int, list[StudySession]] = {}
    for session in db.scalars(query):
        found.setdefault(session.visit.participant_id, []).append(session)
    return found


def recordings(db: Session, recording_ids: Collection[int]) -> Sequence[Recording]:
    """Load recordings without their details; while the caller keeps them, segments find theirs without a query."""
    if not recording_ids:
        return []
    return db.scalars(select(Recording).where(Recording.id.in_(recording_ids)).options(defer(Recording.details))).all()


def stimulation_events(db: Session, recording_ids: Collection[int]) -> dict[int, list[dict[str, Any]]]:
    """Return logged states of the stimulation by recording, in time order: `t_s` and `data` with `rate_hz` and `programs`."""
    events = func.jsonb_path_query_array(Recording.details, cast(literal(STIMULATION_EVENTS), JSONPATH))
    rows = db.execute(select(Recording.id, events).where(Recording.id.in_(recording_ids)))
    return {row[0]: sorted(row[1], key=lambda e: e.get("t_s") or 0.0) for row in rows}


def spans(db: Session, session_ids: Collection[int]) -> dict[tuple[int, int], tuple[float, float]]:
    """Locate sessions in their recordings, s: by session and recording, from the first start to the last stop."""
    rows = db.execute(
        select(SessionSegment.session_id, SessionSegment.recording_id, func.min(SessionSegment.start_s), func.max(SessionSegment.stop_s))
        .where(SessionSegment.session_id.in_(session_ids))
        .group_by(SessionSegment.session_id, SessionSegment.recording_id)
    )
    return {(row[0], row[1]): (row[2], row[3]) for row in rows}


# The evidence of a participant: facts of all sessions that count, and the sessions that do not, with reasons.

READ_AT_ONCE = 8
"""Participants whose traces are in memory together."""


def some_at_once(places: Sequence[int]) -> Iterator[Sequence[int]]:
    """Yield places in a list of participants, READ_AT_ONCE at a time: evidence of all of a large study is too much for the memory."""
    for start in range(0, len(places), READ_AT_ONCE):
        yield places[start : start + READ_AT_ONCE]


@dataclass(frozen=True)
class Evidence:
    """Facts of a participant's sessions that a caller may know.

    Attributes:
        key: names participant, row versions and what the caller may know: equal keys, equal evidence.
        sessions: those that count, by visit and order. excluded: the others.
        beta_unit, beta_source: as the participant's settings have them. failed: what a stopped session counts as.
    """

    participant: str
    participant_id: int
    key: Hashable
    sessions: tuple[Facts, ...]
    excluded: tuple[Excluded, ...]
    beta_unit: str | None
    beta_source: str | None
    failed: Qoc


def evidence(db: Session, participant: Participant, caller: Caller) -> Evidence:
    """Return the evidence of a participant, as the caller may know it; errors as in `app.study.blinding`."""
    return of_all(db, [participant], caller)[0]


def keys_of(db: Session, participants: Sequence[Participant], caller: Caller) -> list[Hashable]:
    """Return the keys of the participants' evidence: they change with everything it depends on."""
    versions = fingerprints(db, [p.id for p in participants])
    sights = blinding.sights(db, participants, caller)
    return [("evidence", p.id, versions[p.id], sight) for p, sight in zip(participants, sights, strict=True)]


def of_all(db: Session, participants: Sequence[Participant], caller: Caller, keys: Sequence[Hashable] | None = None) -> list[Evidence]:
    """Return the evidence of several participants; what is not cached is read for some of them at once. `keys`: theirs, where already
    computed.
    """
    keys = keys_of(db, participants, caller) if keys is None else keys
    found: list[Evidence | None] = [recalled(key) for key in keys]
    lacking = [i for i, known in enumerate(found) if known is None]
    for some in some_at_once(lacking):
        sessions = sessions_of(db, [participants[i].id for i in some])
        everything = [session for held in sessions.values() for session in held]
        late = late_stops(db, [participants[i].id for i in some])
        shares = policy_shares(db, [session.id for session in everything])
        traces = study.traces_of_recordings(db, {s.recording_id for session in everything for s in session.segments})
        held = _recordings_of_several_sides(db, everything, traces)
        for i in some:
            result = _read(participants[i], sessions.get(participants[i].id, []), traces, caller, keys[i], late, shares)
            found[i] = keep(keys[i], result)
        del held  # until here the segments found theirs without a query each
    return [known for known in found if known is not None]


def _recordings_of_several_sides(
    db: Session, sessions: Sequence[StudySession], traces: Mapping[int, Sequence[Trace]]
) -> Sequence[Recording]:
    """Load recordings of sessions with several sides or programs; those of all others, nearly all, are never queried."""
    several = [s for s in sessions if several_sides(s, lambda i: traces.get(i, []))]
    return recordings(db, {g.recording_id for s in several for g in s.segments})


def _read(
    participant: Participant,
    held: Sequence[StudySession],
    traces: Mapping[int, Sequence[Trace]],
    caller: Caller,
    key: Hashable,
    late: Collection[int],
    shares: Mapping[int, float],
) -> Evidence:
    counted: list[Facts] = []
    excluded: list[Excluded] = []
    for session in held:
        place = session.id, session.visit.number, session.ordinal
        if session.status == "proposed":
            excluded.append(Excluded(*place, LeftOut.NOT_CONFIRMED, ""))
        elif session.excluded_reason:
            excluded.append(Excluded(*place, LeftOut.EXCLUDED, session.excluded_reason))
        elif (arm := blinding.visible_arm(session, caller)) is None:
            excluded.append(Excluded(*place, LeftOut.SEALED if session.visit.sealed else LeftOut.HIDDEN, ""))
        else:
            try:
                facts = read(session, arm, lambda i: traces.get(i, []), late_stop=session.id in late, policy_share=shares.get(session.id))
                counted.append(facts)
            except Invalid as error:
                excluded.append(Excluded(*place, LeftOut.UNREADABLE, error.detail, arm, session.duration_s))
    settings = participant.current_settings
    return Evidence(
        participant.code,
        participant.id,
        key,
        tuple(counted),
        tuple(excluded),
        settings.beta_unit,
        settings.beta_source,
        failed_qoc_of(held),
    )
