"""The evidence of a participant: facts of all sessions that count, and the sessions that do not, with reasons."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis.evidence.facts import Excluded, Facts, LeftOut, read
from app.platform.errors import Invalid
from app.platform.kept import kept
from app.study import blinding
from app.study import repository as study
from app.study.models import Participant
from app.study.sessions.repository import fingerprints


@dataclass(frozen=True)
class Evidence:
    """What a caller may know of a participant's sessions.

    Attributes:
        key: names participant, row versions and what the caller may know: equal keys, equal evidence.
        sessions: those that count, by visit and order. excluded: the others.
        beta_unit, beta_source: as the participant's settings have them.
    """

    participant: str
    participant_id: int
    key: Hashable
    sessions: tuple[Facts, ...]
    excluded: tuple[Excluded, ...]
    beta_unit: str | None
    beta_source: str | None


def evidence(db: Session, participant: Participant, caller: Caller) -> Evidence:
    """The evidence of a participant, as the caller may know it; errors as in `app.study.blinding`."""
    return of_all(db, [participant], caller)[0]


def of_all(db: Session, participants: Sequence[Participant], caller: Caller) -> list[Evidence]:
    """The evidence of several participants; whether it has changed is asked of all at once."""
    versions = fingerprints(db, [p.id for p in participants])
    return [_of(db, p, caller, versions[p.id]) for p in participants]


def _of(db: Session, participant: Participant, caller: Caller, fingerprint: str) -> Evidence:
    key = ("evidence", participant.id, fingerprint, blinding.sight(db, participant, caller))
    return kept(key, lambda: _read(db, participant, caller, key))


def _read(db: Session, participant: Participant, caller: Caller, key: Hashable) -> Evidence:
    held = study.sessions_of_participant(db, participant.id, with_proposals=True)
    traces = study.traces_of_recordings(db, {s.recording_id for session in held for s in session.segments})
    counted: list[Facts] = []
    excluded: list[Excluded] = []
    for session in held:
        place = session.id, session.visit.number, session.ordinal
        if session.excluded_reason:
            excluded.append(Excluded(*place, LeftOut.EXCLUDED, session.excluded_reason))
        elif session.status == "proposed":
            excluded.append(Excluded(*place, LeftOut.NOT_CONFIRMED, ""))
        elif (arm := blinding.visible_arm(session, caller)) is None:
            excluded.append(Excluded(*place, LeftOut.HIDDEN, ""))
        else:
            try:
                counted.append(read(session, arm, lambda i: traces.get(i, [])))
            except Invalid as error:
                excluded.append(Excluded(*place, LeftOut.UNREADABLE, error.detail))
    settings = participant.current_settings
    return Evidence(participant.code, participant.id, key, tuple(counted), tuple(excluded), settings.beta_unit, settings.beta_source)
