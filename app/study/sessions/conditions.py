"""Conditions of a session: recorded when it is confirmed, corrected by a person afterwards, never read from today's settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import SYSTEM, Caller
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.study import access, blinding, repository
from app.study.recordings import controller_log
from app.study.schemas import ConditionsChange, ConditionsFields
from app.study.sessions import designs
from app.study.traces import StepTable, driving, step_table
from app.study.visits import require_unlocked
from app.tables.participants import SettingsVersion
from app.tables.recordings import Recording
from app.tables.sessions import Controller, SessionConditions, StudySession

OF_SETTINGS = ("lower_bound", "window", "period_s", "xi_beta")
"""Conditions that a settings version defines for the sessions under it."""
NEEDED = ("lower_bound", "window", "period_s")
"""What every session ran under: a correction may replace it and not take it back."""


def record(db: Session, session: StudySession, by: str, stated: ConditionsChange | None = None) -> SessionConditions:
    """Record the conditions of a session as it is confirmed; one that has conditions keeps them.

    B, W, period and threshold are those of the settings that were in force when it began, by the clock. The present ones, marked as
    assumed, are taken where its start is not known or is before the participant's first settings.

    Args:
        by: author of the record. stated: what a person or a plan says of it, which counts before anything else.
    """
    if session.conditions is not None:
        return session.conditions
    settings, in_force = settings_of(session)
    values: dict[str, Any] = {name: getattr(settings, name) for name in OF_SETTINGS}
    table = _steps(db, session)
    values |= {"seed": None, "design": None, "design_parameters": {}} | _of_recordings(db, session, table)
    of_plan = False
    arm = blinding.stated_arm(session, SYSTEM)
    if table is not None and arm is not None and arm.controller is Controller.RANDOM:
        found = designs.planned(db, session, table, session.visit.participant.current_settings.period_s)
        values, of_plan = values | (found or {}), found is not None
    given = _given(stated) if stated is not None else {}
    told = of_plan or bool(given.keys() & set(OF_SETTINGS))
    origin = "stated" if told else "settings" if in_force else "assumed"
    return _add(db, session, values | given, origin, by, stated.reason if stated else None)


def change(db: Session, session: StudySession, wanted: ConditionsChange, caller: Caller) -> SessionConditions:
    """Correct the conditions of a session: a new revision; omitted fields stay. Same values, no revision.

    Raises:
        Conflict: a proposal, which has none yet, or a locked visit.
        Invalid: B, W or period taken back, or a lower limit above the upper one.
    """
    access.require(caller, can.WRITE_STUDY, session.visit.participant)
    if session.status != "confirmed":
        raise Conflict(f"Session {session.id} is a proposal that is not confirmed yet.", "Confirm it first; then state its conditions.")
    require_unlocked(session.visit)
    repository.lock_session(db, session)
    known = record(db, session, caller.label)
    present = {name: getattr(known, name) for name in ConditionsFields.model_fields}
    given = _given(wanted)
    missing = [name for name in NEEDED if name in given and given[name] is None]
    if missing:
        raise Invalid(f"A session always ran under some {' and '.join(missing)}.", "Give the value, or leave the member out.")
    merged = present | given
    if merged == present:
        return known
    low, high = merged["min_ma"], merged["max_ma"]
    if low is not None and high is not None and low > high:
        raise Invalid(f"The lower limit of {low:g} mA is above the upper one of {high:g} mA.", "Give min_ma below max_ma.")
    set_reason(db, wanted.reason)
    origin = "stated" if given.keys() & set(OF_SETTINGS) else known.origin
    return _add(db, session, merged, origin, caller.label, wanted.reason)


def renew(db: Session, session: StudySession, by: str, reason: str) -> None:
    """Update the conditions from the recordings after these were replaced; all else stays."""
    known = record(db, session, by)
    present = {name: getattr(known, name) for name in ConditionsFields.model_fields}
    told = {name: value for name, value in _of_recordings(db, session, _steps(db, session)).items() if value not in (None, [])}
    if present | told != present:
        _add(db, session, present | told, known.origin, by, reason)


def _steps(db: Session, session: StudySession) -> StepTable | None:
    """Read the session's steps; None where they cannot be read, for which its page and every buffer give the reason."""
    try:
        return step_table(db, session, session.visit.participant.current_settings)
    except Invalid:
        return None


def _of_recordings(db: Session, session: StudySession, table: StepTable | None) -> dict[str, Any]:
    """Read the conditions of a session from recordings, visit and bundles."""
    values: dict[str, Any] = dict(zip(("min_ma", "max_ma"), _limits(db, session) or (None, None), strict=True))
    values["programming"] = [p.as_json() for p in designs.programs_of_session(session)]
    values["lead_amplitude_ma"] = lead_amplitude_ma(table) if table is not None else None
    values["cdbs_amplitude_ma"] = table.cdbs_ma if table is not None else None
    return values


def settings_of(session: StudySession) -> tuple[SettingsVersion, bool]:
    """Return the settings that a session ran under, and whether they were in force by the clock; else the present ones."""
    versions = session.visit.participant.settings
    began = session.started_at
    before = [v for v in versions if began is not None and v.created_at <= began]
    return (before[-1], True) if before else (versions[-1], False)


def lead_amplitude_ma(table: StepTable) -> float | None:
    """Return the amplitude in force just before a session, mA: that of the newest row before its start; None where none is known."""
    before = table.amplitude_ma[table.t_s <= 0]
    known = before[np.isfinite(before)]
    return float(known[-1]) if known.size else None


def _given(wanted: ConditionsChange) -> dict[str, Any]:
    """Return the values that a change states, whole: null empties a list or an object."""
    whole = wanted.model_dump(include=wanted.model_fields_set - {"reason"})
    empty: dict[str, Any] = {"design_parameters": {}, "programming": []}
    return {name: empty.get(name) if value is None else value for name, value in whole.items()}


def _add(db: Session, session: StudySession, values: dict[str, Any], origin: str, by: str, reason: str | None) -> SessionConditions:
    revision = len(session.conditions_revisions) + 1
    row = SessionConditions(session_id=session.id, revision=revision, origin=origin, entered_by=by, reason=reason, **values)
    session.conditions_revisions.append(row)
    db.flush()
    return row


def _limits(db: Session, session: StudySession) -> tuple[float, float] | None:
    """Return amplitude limits, mA: the controller's by its log, else the device's for the controlled program, else the bundle's."""
    control = next((s.recording for s in session.segments if s.is_control), None)
    said = controller_log.limits_and_policy(control) if control is not None else None
    if said is not None:
        return float(said["min_ma"]), float(said["max_ma"])
    found = _device_limits(db, session, control) if control is not None else None
    if found is not None:
        return found
    arm = blinding.stated_arm(session, SYSTEM)
    return None if arm is None or arm.policy_id is None else repository.released_limits(db, arm.policy_id, session.started_at)


def _device_limits(db: Session, session: StudySession, recording: Recording) -> tuple[float, float] | None:
    """Return the limits of the recording's own program, where its device says which of them that was."""
    rows: dict[str, tuple[float, float]] = {}
    for programs in (recording.details.get("limits") or {}).values():
        for name, limit in programs.items() if isinstance(programs, Mapping) else ():
            if isinstance(limit, Mapping) and {"lower_ma", "upper_ma"} <= limit.keys() and limit["lower_ma"] <= limit["upper_ma"]:
                if name in rows and rows[name] != (limit["lower_ma"], limit["upper_ma"]):
                    return None  # several groups have such a program, and which one was active is not known
                rows[name] = (float(limit["lower_ma"]), float(limit["upper_ma"]))
    if len(rows) == 1:
        return next(iter(rows.values()))
    controlled = driving(session, repository.traces_of_recording(db, recording.id))
    return rows.get(controlled.channel) if controlled is not None else None
