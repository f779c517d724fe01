"""Planned against done: sessions proposed into the slots of a signed plan, confirmed in one step. The caller commits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import SYSTEM, Caller
from app.ingest import repository as ingest
from app.ingest.proposals import service as proposals
from app.ingest.schemas import ProposalChange
from app.planning.plans import view as plans
from app.planning.plans.view import PlanLine, PlanView
from app.planning.slots import repository
from app.planning.slots.matching import NO_SLOT, Deviation, Done, Match, Planned, match
from app.planning.visit_day import repository as clinic_day
from app.planning.visit_day.record import SlotTimes, times_of
from app.planning.visit_day.session_outcomes import differences, take_outcomes
from app.platform.errors import BetaloopError, Conflict
from app.study import access
from app.study.blinding import require_known, stated_arm
from app.study.recordings import controller_log
from app.study.sessions.contradictions import control_recording
from app.study.sessions.usable_steps import session_data
from app.study.visits import require_unlocked
from app.tables.plans import DayEntry
from app.tables.sessions import Controller, StudySession
from app.tables.uploads import SessionProposal
from app.tables.visits import Visit
from ml.outcomes import FIELDS

QUANTITIES = ("energy", *FIELDS)
"""What is predicted of a session and seen in it: mean squared fraction of cDBS, and outcomes in their units."""


@dataclass(frozen=True)
class Row:
    """One slot, or one unplanned session.

    Attributes:
        line: of the plan; None for a session outside it. session: that fills it; None where none was found.
        confirmed: whether a person has put it there. proposed: whether the session itself waits for confirmation.
        predicted, done: `QUANTITIES` that are known, by name.
        differences: what the clinic day says otherwise than the confirmed session, in sentences.
    """

    line: PlanLine | None
    session: StudySession | None
    deviations: tuple[Deviation, ...]
    confirmed: bool
    proposed: bool
    predicted: dict[str, float]
    done: dict[str, float]
    differences: tuple[str, ...]


@dataclass(frozen=True)
class Comparison:
    """A visit as planned and as done."""

    view: PlanView
    rows: list[Row]

    @property
    def planned(self) -> int:
        """Slots of the plan."""
        return sum(r.line is not None for r in self.rows)

    @property
    def found(self) -> int:
        """Slots that a session fills, confirmed or proposed."""
        return sum(r.line is not None and r.session is not None for r in self.rows)

    @property
    def carry_over(self) -> int:
        """Number of sessions of a plan that this one replaced."""
        return sum(Deviation.EARLIER_PLAN in r.deviations for r in self.rows)

    @property
    def missing(self) -> list[PlanLine]:
        """Slots that nothing fills."""
        return [r.line for r in self.rows if r.line is not None and r.session is None]

    @property
    def waiting(self) -> list[Row]:
        """Rows that are put into their slot when the visit is confirmed."""
        return [r for r in self.rows if r.line is not None and r.session is not None and not r.confirmed]

    @property
    def asks_about_day(self) -> list[Row]:
        """Rows whose session ran on another day than the visit's."""
        return [r for r in self.waiting if Deviation.OTHER_DAY in r.deviations]


def compare(db: Session, visit: Visit, caller: Caller) -> Comparison:
    """Match the slots of a visit's signed plan with the sessions that fill them.

    While the key is sealed it is the machine that knows what ran: what people are shown of it goes through `serializers`.

    Raises:
        NotFound: the visit has no plan. Conflict: the plan was never signed. Forbidden: the caller may not know what ran.
    """
    if not visit.sealed:
        require_known(visit, caller)
    view = plans.read_plan(db, visit, caller)
    if view.plan.status != "approved":
        raise Conflict(f"Plan {view.plan.id} of visit {visit.number} is not signed.", "Sessions are compared only with signed plans.")
    sessions = {s.id: s for s in repository.sessions_of_day(db, visit.id)}
    entries = clinic_day.entries(db, view.plan.id)
    times = times_of(entries)
    slots = [_planned(line, times) for line in view.lines]
    lines = {line.item.id: line for line in view.lines}
    found = match(slots, [_done(db, s) for s in sessions.values()], visit.date)
    return Comparison(view, [_row(db, one, lines, sessions, entries) for one in found])


def confirm(db: Session, visit: Visit, caller: Caller, *, other_day: bool = False) -> list[str]:
    """Put every found session into its slot, and confirm those that wait for it, all or none.

    Args:
        other_day: whether sessions of another day than the visit's are meant all the same.

    Returns:
        Sentences: what speaks against which sessions, and what the clinic day says otherwise.

    Raises:
        Conflict: nothing is found to confirm, the visit is locked, or sessions of another day are not stated as meant.
        Invalid, Conflict: as confirming a proposal does, with the session's number.
    """
    access.require(caller, can.WRITE_STUDY, visit.participant)
    require_unlocked(visit)
    found = compare(db, visit, caller)
    if not found.waiting:
        raise Conflict(
            f"Visit {visit.number} has nothing to confirm: no session waits for one of its {found.planned} slots.",
            "Upload the recordings of the day, or look at the unplanned sessions.",
        )
    if found.asks_about_day and not other_day:
        held = [r.session for r in found.asks_about_day if r.session is not None]
        days = ", ".join(f"session {s.id} of {s.started_at:%Y-%m-%d}" for s in held)
        raise Conflict(
            f"Recorded on another day than visit {visit.number} ({visit.date}): {days}. Are they meant?",
            "Say so and confirm again, or give these sessions to their own visit.",
            asks="other_day",
        )
    clinic_day.lock_plan(db, found.view.plan.id)  # an entry that arrives meanwhile finds the session in its place
    said: dict[str, list[int]] = {}
    waiting = ingest.proposals(db, [r.session.id for r in found.waiting if r.session is not None])
    for row in found.waiting:
        assert row.session is not None
        for sentence in _fill(db, row, waiting, caller):
            said.setdefault(sentence, []).append(row.session.id)
    return [of_sessions(ids, sentence) for sentence, ids in said.items()]


def _fill(db: Session, row: Row, waiting: dict[int, SessionProposal], caller: Caller) -> list[str]:
    line, session = row.line, row.session
    assert line is not None
    assert session is not None
    said: list[str] = []
    if row.proposed:
        stated = {"controller": line.item.controller} | ({"policy": line.policy.name} if line.policy else {})
        wanted = ProposalChange.model_validate({"version": waiting[session.id].version, **stated, "reason": "as planned"})
        try:
            said += proposals.confirm(db, session, wanted, caller)
        except BetaloopError as error:
            error.detail = f"Session {session.id}, slot {line.item.position}: {error.detail}"
            raise
    session.plan_item_id = line.item.id
    db.flush()
    return said + take_outcomes(db, session, caller)


def _planned(line: PlanLine, times: dict[int, SlotTimes]) -> Planned:
    entered = times.get(line.item.id)
    began = entered.attempts[-1].started_at if entered is not None and entered.attempts else None
    return Planned(line.item.id, Controller(line.item.controller), line.item.policy_id, line.item.minutes, began)


def _done(db: Session, session: StudySession) -> Done:
    recording = control_recording(session)
    slot = controller_log.slot_of_recording(db, recording)
    # a number that this participant's plans do not have, or have for another session, may be that of any slot here
    of_log = None if slot is None else slot.slot_id if slot.planned is not None else NO_SLOT
    # while the key is sealed a stated or guessed controller counts for nothing: where it were put to would reveal what ran there
    arm = None if session.visit.sealed else stated_arm(session, SYSTEM)
    controller, policy = (arm.controller, arm.policy_id) if arm is not None else (None, None)
    return Done(
        session.id,
        controller,
        policy,
        session.duration_s,
        session.started_at,
        session.plan_item_id,
        of_log,
        controller_log.rehearsed(recording),
        controller_log.policy_share(recording) == 0.0,
    )


def _row(db: Session, found: Match, lines: dict[int, PlanLine], sessions: dict[int, StudySession], entries: Sequence[DayEntry]) -> Row:
    line = None if found.item_id is None else lines[found.item_id]
    session = None if found.session_id is None else sessions[found.session_id]
    return Row(
        line,
        session,
        found.deviations,
        confirmed=session is not None
        and (Deviation.EARLIER_PLAN in found.deviations or (line is not None and session.plan_item_id == line.item.id)),
        proposed=session is not None and session.status == "proposed",
        predicted=_predicted(line),
        done=_shown(db, session) if session is not None else {},
        differences=tuple(differences(session, entries)) if session is not None else (),
    )


def _predicted(line: PlanLine | None) -> dict[str, float]:
    if line is None:
        return {}
    named = dict(line.estimate.predicted) if line.estimate else {}
    if line.predicted_energy is not None:
        named["energy"] = line.predicted_energy
    return {name: float(named[name]) for name in QUANTITIES if named.get(name) is not None}


def _shown(db: Session, session: StudySession) -> dict[str, float]:
    """Return the results of a session; its energy over the steps of known amplitude."""
    table = session_data(db, session).table
    fraction = table.fraction[(table.t_s > 0) & ~np.isnan(table.fraction)]
    found = {"energy": float(np.mean(fraction**2)) if fraction.size else None}
    found |= {name: getattr(session.qoc, name, None) for name in QUANTITIES[1:]}
    return {name: float(value) for name, value in found.items() if value is not None}


def of_sessions(numbers: Sequence[int], sentence: str) -> str:
    """Name the sessions that a sentence is about."""
    return f"{'Session' if len(numbers) == 1 else 'Sessions'} {', '.join(map(str, numbers))}: {sentence}"
