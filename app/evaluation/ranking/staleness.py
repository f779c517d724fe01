"""Check of a ranking against the present study: whether it is still current, and what has changed since where it is not, as typed flags.

The snapshot's pins are compared with the present rows: settings version, sessions, QoC revisions, traces, cDBS amplitudes, the gate. By the
audit trail, all else of a session that decides on its steps is compared too. No trace and no buffer is read for it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation import repository
from app.learning import repository as learning
from app.learning.gate import gate
from app.platform.errors import Invalid
from app.platform.kept import kept
from app.study import blinding
from app.study import repository as study_repository
from app.study.sessions.repository import ReadOnce
from app.study.traces import Sources, sources
from app.tables.evaluations import Evaluation
from app.tables.learning import BufferSnapshot, SnapshotSession
from app.tables.participants import Participant, SettingsVersion
from app.tables.sessions import LEARNED, StudySession
from ml.ope import Flag

NAMED = 5
"""Policies that are named where a ranking lacks some."""

OF_STEPS = ("controller", "policy_id", "duration_s", "control_stream", "control_channel")
"""Columns of a session that its steps in a buffer depend on, besides what a snapshot pins."""

TIMED = "started_at"
"""Column that places the session among the others and among the visit's doses."""

STOPPED = "stopped_reason"
"""Column that makes the session a failure in a buffer, whatever the reason."""


def stale_reasons(db: Session, participant: Participant, evaluation: Evaluation, sessions: ReadOnce | None = None) -> list[Flag]:
    """List the reasons why the ranking no longer matches the present study; empty when it does.

    Args:
        db: the session. participant: whose. evaluation: the ranking's.
        sessions: of the participant, where other code reads them too.
    """
    reasons: list[Flag] = []
    settings = participant.current_settings
    if settings.xi_beta is None:
        reasons.append(Flag("no_threshold"))
    if evaluation.settings_version_id != settings.id:
        old = study_repository.settings_version(db, evaluation.settings_version_id).version
        reasons.append(Flag("settings_changed", float(settings.version), float(old)))
    sessions = sessions or ReadOnce(db, participant.id)
    reasons += _kept_changes(db, participant, db.get_one(BufferSnapshot, evaluation.snapshot_id), sessions)
    ranked = set(evaluation.diagnostics.get("candidates", []))
    missing = [name for number, name in learning.candidate_names(db, participant.id).items() if number not in ranked]
    if missing:
        reasons.append(Flag.of("policies_missing", float(len(missing)), None, "policies", names=tuple(missing[:NAMED])))
    return reasons


def _kept_changes(db: Session, participant: Participant, snapshot: BufferSnapshot, sessions: ReadOnce) -> list[Flag]:
    """Return the result of `_changes`, cached by this process until a row of the participant's sessions changes, or the gate is decided on.

    What this transaction has read before may be older than the key says, so that settings are read again, as `sessions` are.
    """
    decision = learning.newest_gate_decision(db, participant.id)
    sealed = study_repository.hidden_visits(db, [participant.id]).sealed(participant.id)
    key = ("changes since", snapshot.id, snapshot.created_at, sessions.fingerprint, decision.id if decision else None, sealed)

    def read() -> list[Flag]:
        rows = sessions.rows
        db.refresh(participant, ["settings"])
        return _changes(db, participant, snapshot, rows)

    return kept(key, read)


def _changes(db: Session, participant: Participant, snapshot: BufferSnapshot, sessions: Sequence[StudySession]) -> list[Flag]:
    """List what happened to the sessions since a snapshot."""
    before = {m.session_id: m for m in learning.snapshot_members(db, snapshot.id)}
    now = {s.id: s for s in sessions}
    added = [s for s in sessions if s.id not in before]
    both = [(before[i], now[i]) for i in sorted(before.keys() & now.keys())]
    heads = study_repository.trace_heads(db, {g.recording_id for s in sessions for g in s.segments})
    moved, readmitted, redosed, retimed = _edited(db, [s for _, s in both], snapshot.created_at)
    barrier = gate(db, participant, sessions)
    opened = barrier.is_open and barrier.decision is not None and barrier.decision.created_at > snapshot.created_at
    found = Counter({"newer": len(added), "unconfirmed": len(before.keys() - now.keys())})
    for pinned, session in both:
        learned = blinding.arm(session, SYSTEM).controller in LEARNED
        shut_out = bool(session.excluded_reason) or (learned and not barrier.is_open) or session.visit.sealed
        unsealed = session.visit.unsealed_at is not None and session.visit.unsealed_at > snapshot.created_at
        free = session.id in readmitted or (learned and opened) or unsealed
        found["qoc"] += (session.qoc.id if session.qoc else None) != pinned.qoc_id
        found["conditions"] += pinned.conditions_id is not None and (session.conditions and session.conditions.id) != pinned.conditions_id
        found["left_out"] += shut_out and pinned.left_out_reason is None
        found["included"] += free and not shut_out and pinned.left_out_reason is not None
        present = _sources(session, participant.current_settings, heads)
        if present is not None and _was_read(pinned):
            old = (pinned.beta_trace_id, pinned.amplitude_trace_id)
            found["decoded"] += (present.beta_trace_id, present.amplitude_trace_id) != old
            found["cdbs"] += present.cdbs_ma != pinned.cdbs_amplitude_ma
    found["moved"], found["doses"], found["retimed"] = len(moved), len(redosed), len(retimed - moved)
    visits = tuple(str(n) for n in sorted({s.visit.number for s in added}))
    return [Flag.of("sessions_changed", float(n), None, "sessions", change=change, visits=visits) for change, n in found.items() if n]


def _sources(session: StudySession, settings: SettingsVersion, heads: Mapping[int, Any]) -> Sources | None:
    """Find what the session's steps are read from now; None where its side is not known, so that they cannot be read."""
    try:
        return sources(session, settings, heads)
    except Invalid:
        return None


def _was_read(pinned: SnapshotSession) -> bool:
    """Check whether the snapshot could read the session's steps at all: what it could not read it has no pins of."""
    return pinned.left_out_reason is None or any(
        pin is not None for pin in (pinned.beta_trace_id, pinned.amplitude_trace_id, pinned.cdbs_amplitude_ma)
    )


def _edited(db: Session, sessions: Sequence[StudySession], moment: datetime) -> tuple[set[int], set[int], set[int], set[int]]:
    """Find sessions that changed since a moment.

    Returns:
        Sessions whose steps are other ones. Those that a person had excluded then and not any more. Those whose time since medication may
        be another, by the visit's doses. Those whose start was on a wrong clock.
    """
    ids, visits = [s.id for s in sessions], {s.visit_id for s in sessions}
    wanted = {"session": ("id", ids), "session_segment": ("session_id", ids), "visit": ("id", visits), "dose": ("visit_id", visits)}
    changed = repository.changed_since(db, moment, wanted)
    moved, readmitted, retimed = set(), set(), set()
    for before, after in _pairs(*changed["session"]):
        if any(before[name] != after[name] for name in OF_STEPS) or bool(before[STOPPED]) != bool(after[STOPPED]):
            moved.add(int(after["id"]))
        if before[TIMED] != after[TIMED]:
            retimed.add(int(after["id"]))
        if before["excluded_reason"] and not after["excluded_reason"]:
            readmitted.add(int(after["id"]))
    then, now = changed["session_segment"]
    moved |= {int(row["session_id"]) for row in (*(r for r in then if r not in now), *(r for r in now if r not in then))}
    renumbered = {int(after["id"]) for before, after in _pairs(*changed["visit"]) if before["number"] != after["number"]}
    dosed = {int(row["visit_id"]) for rows in changed["dose"] for row in rows}
    redosed = {s.id for s in sessions if s.visit_id in dosed and s.medication_h is None}
    return moved | {s.id for s in sessions if s.visit_id in renumbered}, readmitted, redosed, retimed


def _pairs(then: list[dict[str, Any]], now: list[dict[str, Any]]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Pair the rows that existed then and exist now."""
    present = {row["id"]: row for row in now}
    return [(row, present[row["id"]]) for row in then if row["id"] in present]
