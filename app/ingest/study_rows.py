"""Entries that one row of a study's sheet makes: its visit, the confirmation of its session, outcomes, medication and design.

A value that is there already is never replaced; a row that differs from it is reported.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.ingest import repository
from app.ingest.proposals import service as proposals
from app.ingest.schemas import ProposalChange
from app.study import blinding, visits
from app.study import repository as study
from app.study.schemas import ConditionsChange, QocIn, SessionChange, VisitIn
from app.study.sessions import changes, conditions
from app.study.traces import step_table
from app.tables.participants import Participant
from app.tables.sessions import Controller, StudySession
from app.tables.visits import Visit
from ml.formats.studies.sheet import SheetRow

REASON = "import of the study's sheet"
AMPLITUDE_DIFFERS = 0.05
"""A recorded amplitude under cDBS that differs from the sheet's by more than this share is reported."""


def enter_row(db: Session, session: StudySession, row: SheetRow, caller: Caller, dry_run: bool) -> list[str]:
    """Confirm a session as its row says, and enter outcomes, medication and design. Returns what was done; nothing where all was there."""
    said: list[str] = []
    visit, made = find_visit(db, session.visit.participant, row, caller)
    said += made
    if session.status == "proposed":
        change: dict[str, Any] = {"visit": visit.number, "controller": row.controller, "reason": REASON}
        change |= {"policy": row.policy} if row.policy else {}
        change |= {"hemisphere": row.hemisphere} if row.hemisphere and row.hemisphere != session.hemisphere else {}
        if session.started_at is None and row.start is not None:
            change["started_at"] = row.start
        version = repository.proposal(db, session.id, caller).version
        notes = proposals.confirm(db, session, ProposalChange(version=version, **change), caller)
        said += [f"visit {visit.number}, {row.controller}", *notes]
    else:
        arm = blinding.visible_arm(session, caller)
        if session.visit_id != visit.id or (arm is not None and arm.controller != row.controller):
            ran = arm.controller if arm else "hidden"
            said.append(f"not changed: it is of visit {session.visit.number}, {ran}, and the sheet says {visit.number}, {row.controller}")
            return said
    said += _outcomes(db, session, row, caller)
    said += _medication(db, session, row, caller)
    said += _design(db, session, row, caller)
    return said + _amplitude(db, session, row)


def find_visit(db: Session, participant: Participant, row: SheetRow, caller: Caller) -> tuple[Visit, list[str]]:
    """Find the visit of a row, or add it; and sentences on what was added or differs."""
    visit = study.visit_by_number(db, participant.id, row.visit)
    if visit is None:
        visit = visits.add_visit(db, participant, VisitIn(number=row.visit, date=row.day), caller)
        return visit, [f"visit {row.visit} added" + (f" on {row.day}" if row.day else "")]
    differs = row.day is not None and visit.date not in (None, row.day)
    return visit, [f"visit {row.visit} is of {visit.date}, and the sheet says {row.day}"] if differs else []


def _outcomes(db: Session, session: StudySession, row: SheetRow, caller: Caller) -> list[str]:
    known = {name: value for name in row.outcomes if (value := getattr(session.qoc, name, None)) is not None}
    differ = [
        f"{name} is {known[name]:g}, and the sheet says {value:g}: not changed"
        for name, value in row.outcomes.items()
        if name in known and not np.isclose(known[name], value)
    ]
    fresh = {name: value for name, value in row.outcomes.items() if name not in known}
    if fresh:
        changes.record_qoc(db, session, QocIn(**fresh, reason=REASON), caller)
    return [*(f"{name} {value:g}" for name, value in fresh.items()), *differ]


def _medication(db: Session, session: StudySession, row: SheetRow, caller: Caller) -> list[str]:
    hours = row.medication_h
    if hours is None and row.last_dose is not None and session.started_at is not None:
        hours = round((session.started_at - row.last_dose).total_seconds() / 3600.0, 3)
    if hours is None or session.medication_h is not None:
        return []
    if not 0 <= hours <= 72:
        return [f"the last dose would have been {hours:g} h before the start: not entered"]
    changes.change_session(db, session, SessionChange(medication_h=hours, reason=REASON), caller)
    return [f"last dose {hours:g} h before"]


def _design(db: Session, session: StudySession, row: SheetRow, caller: Caller) -> list[str]:
    present = session.conditions
    fresh = {n: v for n, v in row.design.items() if (present is None or getattr(present, n) != v)}
    if not fresh or row.controller != Controller.RANDOM:
        return []
    conditions.change(db, session, ConditionsChange.model_validate({**fresh, "reason": REASON}), caller)
    return [f"design: {', '.join(fresh)}"]


def _amplitude(db: Session, session: StudySession, row: SheetRow) -> list[str]:
    """Compare the recorded amplitude of a cDBS session with the sheet's."""
    if row.amplitude_ma is None or row.controller != Controller.CDBS or session.visit.sealed:
        return []
    values = step_table(db, session, session.visit.participant.current_settings).amplitude_ma
    known = values[np.isfinite(values)]
    if not known.size or abs(np.median(known) - row.amplitude_ma) <= AMPLITUDE_DIFFERS * max(row.amplitude_ma, 0.1):
        return []
    return [f"look at this: the sheet says {row.amplitude_ma:g} mA, and the recording {float(np.median(known)):g} mA"]
