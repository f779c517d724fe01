"""Contradictions between the statements about a session (visit, controller, side, start) and its recordings; words: `wording.py`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta, timezone
from enum import StrEnum
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.platform.database import now
from app.platform.errors import Invalid
from app.study import blinding
from app.study.doses import disagreement_h
from app.study.recordings import amplitude_sources, controller_log
from app.study.recordings.facts import unknown_clock
from app.study.sessions import designs
from app.study.sessions.stimulation import SILENT_MA, Delivered, contradicts, delivered
from app.study.traces import step_table
from app.tables.recordings import Recording
from app.tables.sessions import LEARNED, Controller, StudySession

CLOCKS_DIFFER = timedelta(minutes=5)


class Kind(StrEnum):
    """Kind of contradiction; the docstring of each lists the facts that a sentence about it needs."""

    DAY = "day"
    """`day`, `utc_offset_h` (None: UTC), `visit`, `visit_date`."""
    START = "start"
    """`stated`, `by_clock`: moments."""
    FUTURE = "future"
    """`begins`, `now`: moments."""
    SIDE = "side"
    """`stated`, `recorded`: hemispheres; `recording`: its number."""
    UNREADABLE = "unreadable"
    """`detail`, `hint`: why the steps cannot be read."""
    ABOVE_CDBS = "above_cdbs"
    """`above`, `steps`, `cdbs_ma`."""
    AMPLITUDE = "amplitude"
    """`controller`; `side`: its name, None where there is one side only; `mean_fraction`, else `mean` in mA."""
    SILENT_CONTROL = "silent_control"
    """`side`: name of the controlled side; `others`: names of those that had stimulation."""
    NO_POLICY = "no_policy"
    SEVERAL_PROGRAMS = "several_programs"
    """`counted`: name of the program whose amplitude counts; `others`: of those of its side that moved too."""
    LOGGED_POLICY = "logged_policy"
    """`logged`: name of the participant's policy that the log names; `number`, where the participant has none such."""
    LOGGED_CDBS = "logged_cdbs"
    """`logged`, `in_force`: cDBS amplitudes, mA."""
    LOGGED_SLOT = "logged_slot"
    """`position`, `visit`, `visit_date` (as it was): of the planned session that the log names; `other_visit`: of the session."""
    NO_SLOT = "no_slot"
    """`plan`, `position`, `visit`, `visit_date`: of a session of a plan that this participant does not have, or not any more."""
    BENCH = "bench"
    SIMULATED = "simulated"
    LAST_DOSE = "last_dose"
    """`stated`, `by_doses`: hours from the last dose to the start."""
    AMPLITUDE_SOURCES = "amplitude_sources"
    """`names`: of the sources that differ; `seconds`: in all."""
    UNKNOWN_CLOCK = "unknown_clock"
    """`recording`."""
    REPEATED = "repeated"
    """`session`, `recording`: of the other one; `seconds`: that both hold; `counts`: whether the other one counts; `own`: recording."""


@dataclass(frozen=True)
class Contradiction:
    """One thing that a person should look at."""

    kind: Kind
    facts: Mapping[str, Any] = field(default_factory=dict)


def contradictions(db: Session, session: StudySession, visit_open: bool = False, steps_shown: bool = False) -> list[Contradiction]:
    """List contradictions between a session's recordings and its stated controller, side, start and visit.

    While the key of the visit's plan is sealed controller and amplitudes are not compared.

    Args:
        visit_open: the visit is not stated yet, so that its date contradicts nothing.
        steps_shown: the reader sees elsewhere why steps cannot be read, and which lie above the cDBS amplitude.
    """
    found = [*_of_minutes(db, session), *_of_day(session, visit_open), *_of_start(session), *_of_side(session)]
    found += [*_of_slot(db, session), *_of_dose(session), *_of_sources(session)]
    if session.visit.sealed:
        return found  # what follows reveals what ran, and these sentences are kept in reports that everybody reads
    try:
        table = step_table(db, session, session.visit.participant.current_settings)
        sides = delivered(db, session)
    except Invalid as error:
        unreadable = Contradiction(Kind.UNREADABLE, {"detail": error.detail, "hint": error.hint})
        return found if steps_shown else [unreadable, *found]
    if table.above_one and not steps_shown:
        facts = {"above": table.above_one, "steps": int(np.sum(table.t_s > 0)), "cdbs_ma": table.cdbs_ma}
        found.append(Contradiction(Kind.ABOVE_CDBS, facts))
    arm = blinding.stated_arm(session, SYSTEM)
    ran = controller_log.of_recording(db, control_recording(session))
    if ran is not None:
        found += _of_log(ran, arm, table.cdbs_ma)
    found += _of_programs(sides)
    if arm is None:
        return found
    found += _of_controller(session, arm.controller, sides)
    if arm.controller in LEARNED and arm.policy_id is None:
        found.append(Contradiction(Kind.NO_POLICY))
    return found


def _of_sources(session: StudySession) -> Iterator[Contradiction]:
    """Find sources of the amplitude that differ and among which none was chosen, and a start that is on an unknown clock."""
    left = [c for c in amplitude_sources.of_session(session) if c.open]
    if left:
        names = list(dict.fromkeys(name for c in left for name in c.stored["sources"]))
        yield Contradiction(Kind.AMPLITUDE_SOURCES, {"names": names, "seconds": sum(c.stored["to_s"] - c.stored["from_s"] for c in left)})
    control = control_recording(session)
    if unknown_clock(control):
        yield Contradiction(Kind.UNKNOWN_CLOCK, {"recording": control.id})


def utc_offset_h(recording: Recording) -> float | None:
    """Return the offset of the clock where a recording was made, hours, as its file states; None where it states none."""
    hours = recording.details.get("settings", {}).get("utc_offset_h")
    return float(hours) if isinstance(hours, int | float) and -14 <= hours <= 14 else None


def local_day(recording: Recording, moment: datetime) -> date:
    """Return the day of a moment where the recording was made, by the offset that its file states, else in UTC."""
    hours = utc_offset_h(recording)
    return moment.astimezone(UTC if hours is None else timezone(timedelta(hours=hours))).date()


def control_recording(session: StudySession) -> Recording:
    """Return the recording that the controller of a session saw."""
    return next(s for s in session.segments if s.is_control).recording


def _of_minutes(db: Session, session: StudySession) -> Iterator[Contradiction]:
    for one in designs.others(db, session):
        facts = {"session": one.session_id, "recording": one.recording_id, "seconds": one.seconds, "counts": one.counts}
        yield Contradiction(Kind.REPEATED, facts | {"own": control_recording(session).id})


def _of_day(session: StudySession, visit_open: bool) -> Iterator[Contradiction]:
    visit = session.visit
    if visit_open or visit.date is None or session.started_at is None:
        return
    recording = control_recording(session)
    # where the stated start is wrong, the day of the recording is compared with the visit
    day = local_day(recording, recording.started_at or session.started_at)
    if visit.date not in (day, local_day(recording, session.started_at)):
        facts = {"day": day, "utc_offset_h": utc_offset_h(recording), "visit": visit.number, "visit_date": visit.date}
        yield Contradiction(Kind.DAY, facts)


def begins_later(started_at: datetime | None, moment: datetime) -> bool:
    """Return whether a session of a real participant would begin after a moment, by more than clocks differ."""
    return started_at is not None and started_at > moment + CLOCKS_DIFFER


def _of_start(session: StudySession) -> Iterator[Contradiction]:
    moment = now()
    if begins_later(session.started_at, moment) and not session.visit.participant.synthetic:
        yield Contradiction(Kind.FUTURE, {"begins": session.started_at, "now": moment})
    segment = next(s for s in session.segments if s.is_control)
    began = segment.recording.started_at
    if began is None or session.started_at is None:
        return
    by_clock = began + timedelta(seconds=segment.start_s)
    period = session.visit.participant.current_settings.period_s
    if abs((session.started_at - by_clock).total_seconds()) > period:
        yield Contradiction(Kind.START, {"stated": session.started_at, "by_clock": by_clock})


def _of_side(session: StudySession) -> Iterator[Contradiction]:
    recording = control_recording(session)
    if session.hemisphere and recording.hemisphere and session.hemisphere != recording.hemisphere:
        facts = {"stated": session.hemisphere, "recording": recording.id, "recorded": recording.hemisphere}
        yield Contradiction(Kind.SIDE, facts)


def _of_dose(session: StudySession) -> Iterator[Contradiction]:
    apart = disagreement_h(session)
    if apart is not None:
        yield Contradiction(Kind.LAST_DOSE, {"stated": apart[0], "by_doses": apart[1]})


def _of_log(ran: controller_log.Logged, arm: blinding.Arm | None, cdbs_ma: float | None) -> Iterator[Contradiction]:
    """Report another policy than the one that wrote the log, or another cDBS amplitude than it was bounded by."""
    if ran.policy_id is None or (arm is not None and arm.policy_id != ran.policy_id):
        yield Contradiction(Kind.LOGGED_POLICY, {"logged": ran.policy_name, "number": ran.number})
    if cdbs_ma is not None and abs(cdbs_ma - ran.cdbs_ma) > SILENT_MA:
        yield Contradiction(Kind.LOGGED_CDBS, {"logged": ran.cdbs_ma, "in_force": cdbs_ma})


def _of_slot(db: Session, session: StudySession) -> Iterator[Contradiction]:
    """Report a log of a session that is planned at another visit, or nowhere any more; or of no session at all."""
    recording = control_recording(session)
    if controller_log.rehearsed(recording):
        yield Contradiction(Kind.BENCH)
    elif controller_log.simulated(recording) and not session.visit.participant.synthetic:
        yield Contradiction(Kind.SIMULATED)
    slot = controller_log.slot_of_recording(db, recording)
    if slot is None:
        return
    if slot.planned is None or slot.planned.plan_status != "approved":
        facts = {"plan": slot.plan_id, "position": slot.position, "visit": slot.visit_number, "visit_date": slot.visit_date}
        yield Contradiction(Kind.NO_SLOT, facts)
    elif slot.planned.visit_id != session.visit_id:
        facts = {"position": slot.position, "visit": slot.visit_number, "visit_date": slot.visit_date}
        yield Contradiction(Kind.LOGGED_SLOT, facts | {"other_visit": session.visit.number})


def _of_programs(sides: Sequence[Delivered]) -> Iterator[Contradiction]:
    """Report several programs of the controlled side that moved, of which one counts."""
    counted = next((s for s in sides if s.is_control and s.moved), None)
    if counted is not None:
        others = [s.name for s in sides if s is not counted and s.hemisphere == counted.hemisphere and s.moved]
        if others:
            yield Contradiction(Kind.SEVERAL_PROGRAMS, {"counted": counted.name, "others": others})


def _of_controller(session: StudySession, controller: Controller, sides: Sequence[Delivered]) -> Iterator[Contradiction]:
    fixed = controller in (Controller.CDBS, Controller.NO_DBS)
    for side in sides:
        if contradicts(session, controller, side):
            amount, fraction, _ = side.inside
            relative = fraction[~np.isnan(fraction)]
            yield Contradiction(
                Kind.AMPLITUDE,
                {
                    "controller": controller,
                    "side": side.name if len(sides) > 1 else None,
                    "mean_fraction": float(relative.mean()) if relative.size else None,
                    "mean": float(np.nanmean(amount)),
                },
            )
        elif not fixed and side.is_control and side.silent:
            others = [s.name for s in sides if s.stimulated]
            if others:
                yield Contradiction(Kind.SILENT_CONTROL, {"side": side.name, "others": others})
