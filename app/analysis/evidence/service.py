"""The evidence of a participant: facts of all sessions that count, and the sessions that do not, with reasons."""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis.evidence import repository
from app.analysis.evidence.facts import Excluded, Facts, LeftOut, read, several_sides
from app.platform.errors import Invalid
from app.platform.kept import keep, recalled
from app.study import blinding
from app.study import repository as study
from app.study.adverse_events.repository import late_stops
from app.study.sessions.data import failed_qoc_of
from app.study.sessions.repository import fingerprints
from app.tables.participants import Participant
from app.tables.recordings import Recording, Trace
from app.tables.sessions import StudySession
from ml.qoc import Qoc

READ_AT_ONCE = 8
"""Participants whose traces are in memory together."""


@dataclass(frozen=True)
class Evidence:
    """What a caller may know of a participant's sessions.

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
    """The evidence of a participant, as the caller may know it; errors as in `app.study.blinding`."""
    return of_all(db, [participant], caller)[0]


def of_all(db: Session, participants: Sequence[Participant], caller: Caller) -> list[Evidence]:
    """The evidence of several participants; what is not kept is read for some of them at once."""
    versions = fingerprints(db, [p.id for p in participants])
    sights = blinding.sights(db, participants, caller)
    keys = [("evidence", p.id, versions[p.id], sight) for p, sight in zip(participants, sights, strict=True)]
    found: list[Evidence | None] = [recalled(key) for key in keys]
    lacking = [i for i, known in enumerate(found) if known is None]
    for start in range(0, len(lacking), READ_AT_ONCE):
        some = lacking[start : start + READ_AT_ONCE]
        sessions = repository.sessions_of(db, [participants[i].id for i in some])
        everything = [session for held in sessions.values() for session in held]
        late = late_stops(db, [participants[i].id for i in some])
        traces = study.traces_of_recordings(db, {s.recording_id for session in everything for s in session.segments})
        held = _recordings_of_several_sides(db, everything, traces)
        for i in some:
            result = _read(participants[i], sessions.get(participants[i].id, []), traces, caller, keys[i], late)
            found[i] = keep(keys[i], result)
        del held  # until here the segments found theirs without a query each
    return [known for known in found if known is not None]


def _recordings_of_several_sides(
    db: Session, sessions: Sequence[StudySession], traces: Mapping[int, Sequence[Trace]]
) -> Sequence[Recording]:
    """Recordings of sessions with several sides or programs; those of all others, nearly all, are never asked for."""
    several = [s for s in sessions if several_sides(s, lambda i: traces.get(i, []))]
    return repository.recordings(db, {g.recording_id for s in several for g in s.segments})


def _read(
    participant: Participant,
    held: Sequence[StudySession],
    traces: Mapping[int, Sequence[Trace]],
    caller: Caller,
    key: Hashable,
    late: Collection[int],
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
                counted.append(read(session, arm, lambda i: traces.get(i, []), late_stop=session.id in late))
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
