"""Buffer snapshots: which sessions a result rests on, and what they cover."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import structlog
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import SYSTEM, Caller
from app.learning import repository
from app.learning.gate import Gate, gate, gate_grounds
from app.learning.trajectories import trajectory_of
from app.platform import files
from app.platform.database import end_reading
from app.platform.errors import Invalid
from app.platform.kept import kept
from app.study import access, blinding
from app.study import repository as study_repository
from app.study.doses import hours_since_dose
from app.study.sessions import repository as session_repository
from app.study.sessions.designs import Difference, Program, counts_elsewhere, differences, stored
from app.study.sessions.usable_steps import failed_qoc_of, session_data
from app.study.settings import mdp_settings, suggest_xi_beta
from app.study.traces import StepTable, TracesOf, traces_of
from app.tables.learning import BufferSnapshot, SnapshotSession
from app.tables.participants import CharacteristicsVersion, Hemisphere, Participant, SettingsVersion
from app.tables.sessions import LEARNED, StudySession
from ml.mdp import MdpSettings
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory, to_parquet

# Buffer snapshots: which sessions a result may rest on, the version of everything in them, and why the others were excluded.
#
# Every confirmed session is looked at. What cannot enter is kept in the snapshot's list with its reason. Sessions of learned policies
# enter when the gate is open (`app.learning.gate`).

log = structlog.get_logger()

PINS_VERSION = 2
SEALED = "the key of its visit's blinded plan is sealed: a clinician opens it on the page of the plan"
REPEATED = "its minutes of this device stand in another session that counts: exclude one of the two"


@dataclass(frozen=True)
class Member:
    """One confirmed session as the buffer sees it: a trajectory, or the reason why there is none."""

    session: StudySession
    table: StepTable | None
    trajectory: SessionTrajectory | None
    left_out: str | None

    def pins(self) -> list[Any]:
        """List everything of this session that a result depends on."""
        table, s = self.table, self.trajectory
        arm = blinding.arm(self.session, SYSTEM)
        hours = hours_since_dose(self.session)
        return [
            self.session.id,
            self.session.visit.number,
            arm.controller.value,
            arm.policy_id,
            table.beta_trace.id if table and table.beta_trace else None,
            table.amplitude_trace.id if table and table.amplitude_trace else None,
            self.decode_version,
            self.session.qoc.id if self.session.qoc else None,
            self.session.conditions.id if self.session.conditions else None,
            table.cdbs_ma if table else None,
            self.left_out,
            _digest(s) if s else None,
            # absent where not known, so that sessions without a dose have no such pin
            *([] if hours is None else [hours]),
        ]

    @property
    def decode_version(self) -> int | None:
        """Decode version of the session's beta trace."""
        return self.table.beta_trace.decode_version if self.table and self.table.beta_trace else None

    @property
    def programs(self) -> list[Program]:
        """Stimulation programs that the session ran under; empty where they are not known."""
        return stored(self.session.conditions.programming) if self.session.conditions else []

    @property
    def steps(self) -> int | None:
        """Usable steps; None where the session is excluded."""
        return int(self.trajectory.usable().sum()) if self.trajectory else None


@dataclass(frozen=True)
class Collection:
    """The buffer that the study's present data give."""

    settings_version: SettingsVersion
    settings: MdpSettings
    members: tuple[Member, ...]
    beta_unit: str
    beta_source: str

    @property
    def characteristics(self) -> CharacteristicsVersion | None:
        """Of the participant, as they are now."""
        return self.settings_version.participant.current_characteristics

    @cached_property
    def buffer(self) -> ReplayBuffer:
        """The sessions that entered."""
        inside = tuple(m.trajectory for m in self.members if m.trajectory is not None)
        return ReplayBuffer(self.settings, inside, self.beta_unit, self.beta_source)

    @cached_property
    def pins_sha256(self) -> str:
        """Name of everything pinned: equal exactly when nothing that a result depends on has changed."""
        pins: dict[str, Any] = {
            "version": PINS_VERSION,
            "settings_version_id": self.settings_version.id,
            "beta": [self.beta_unit, self.beta_source],
            "sessions": [m.pins() for m in self.members],
        }
        if self.characteristics is not None:
            pins["characteristics_id"] = self.characteristics.id
        return hashlib.sha256(json.dumps(pins, sort_keys=True).encode()).hexdigest()


def collect(db: Session, participant: Participant, sessions: Sequence[StudySession] | None = None) -> Collection:
    """Collect the buffer of the participant from the current data; nothing is stored.

    `sessions`: the confirmed ones, where they are at hand.

    Raises:
        Invalid: no beta threshold yet (with a suggestion from the data), or one without a unit and source. Or no session has a usable step
            (with the reasons).
    """
    version = participant.current_settings
    suggestion = suggest_xi_beta(db, participant, SYSTEM) if version.xi_beta is None else None
    settings = mdp_settings(version, suggestion)
    sessions = study_repository.sessions_of_participant(db, participant.id) if sessions is None else sessions
    placeless = session_repository.repeated_sessions(db, participant.id)
    twice = {s.id for s in sessions if s.id in placeless and counts_elsewhere(db, s)}
    traces = traces_of(db, sessions)
    failed = failed_qoc_of(sessions)
    read = [_read(db, s, version, traces, failed) if s.id not in twice else Member(s, None, None, REPEATED) for s in sessions]
    unit, source = _signal(version, read)
    barrier = gate(db, participant, sessions)
    admitted = _of_one_programming([_admit(m, unit, source) for m in read], version)
    members = tuple(_pass_gate(m, barrier) for m in admitted)
    if not any(m.trajectory for m in members):
        reasons = Counter(m.left_out for m in members)
        listed = "; ".join(f"{n} x {reason}" for reason, n in reasons.most_common(4))
        raise Invalid(
            f"Participant {participant.code} has no session that policies can learn from"
            + (f": {listed}." if listed else ": no confirmed session at all."),
            "Upload sessions with a beta trace and an amplitude trace, or correct what is named.",
        )
    return Collection(version, settings, members, unit, source)


def not_ready(db: Session, participant: Participant) -> Invalid | None:
    """Explain why nothing can be learned or estimated yet; None when it can.

    The result is cached by this process, since every trace is read for it. The cache ends when a row of the participant's sessions or
    settings changes, the gate is decided on, or a visit is sealed or opened. It also ends when another session has the minutes of one
    first.
    """
    sessions = session_repository.ReadOnce(db, participant.id)
    decision = repository.newest_gate_decision(db, participant.id)
    placeless = frozenset(session_repository.repeated_sessions(db, participant.id))
    sealed = study_repository.hidden_visits(db, [participant.id]).sealed(participant.id)
    key = ("not ready", participant.id, sessions.fingerprint, decision.id if decision else None, placeless, sealed)

    def read() -> tuple[str, ...]:
        rows = sessions.rows
        db.refresh(participant, ["settings"])  # what was read before may be older than the key
        try:
            collect(db, participant, rows)
        except Invalid as error:
            return error.detail, error.hint
        return ()

    why = kept(key, read)
    return Invalid(*why) if why else None


def take_snapshot(db: Session, participant: Participant, caller: Caller) -> BufferSnapshot:
    """Store the current buffer; when nothing it depends on has changed, return the snapshot that already pins it.

    Two transactions at once get one row: the unique pins make the later one wait for, and then find, the other's.

    Raises:
        Invalid: as `collect`. Forbidden: the caller may not run jobs.
    """
    access.require(caller, can.RUN_JOBS, participant)
    found = collect(db, participant)
    known = repository.snapshot_by_pins(db, participant.id, found.pins_sha256)
    if known is not None:
        _mend(db, known, found)
        return known
    end_reading(db)
    stored = files.store(db, to_parquet(found.buffer))
    row_id = repository.add_snapshot(
        db,
        participant_id=participant.id,
        settings_version_id=found.settings_version.id,
        characteristics_id=found.characteristics.id if found.characteristics else None,
        pins_sha256=found.pins_sha256,
        file_sha256=stored.sha256,
        sessions=len(found.buffer.sessions),
        steps=sum(m.steps or 0 for m in found.members),
        median_steps=found.buffer.median_steps(),
        beta_unit=found.beta_unit,
        beta_source=found.beta_source,
        created_by=caller.label,
    )
    if row_id is None:
        other = repository.snapshot_by_pins(db, participant.id, found.pins_sha256)
        assert other is not None
        return other
    db.add_all(_row(row_id, m) for m in found.members)
    db.flush()
    return db.get_one(BufferSnapshot, row_id)


def _mend(db: Session, snapshot: BufferSnapshot, found: Collection) -> None:
    """Restore a snapshot's missing or damaged file, where the same data still give the same bytes; else its readers get an error."""
    if not files.is_whole(snapshot.file_sha256):
        content = to_parquet(found.buffer)
        same = hashlib.sha256(content).hexdigest() == snapshot.file_sha256
        log.warning("the file of a snapshot was damaged", snapshot=snapshot.id, sha256=snapshot.file_sha256, made_anew=same)
        if same:
            files.store(db, content)


def _read(db: Session, session: StudySession, version: SettingsVersion, traces: TracesOf, failed: Qoc) -> Member:
    """Read the session's trajectory, or the first reason of its own against it."""
    if session.visit.sealed:
        return Member(session, None, None, SEALED)  # how much was learnt from it, and what, would reveal what ran
    try:
        table = session_data(db, session, traces).table
    except Invalid as error:
        return Member(session, None, None, str(error))
    trajectory = trajectory_of(session, table, blinding.arm(session, SYSTEM), version, failed)
    if isinstance(trajectory, str):
        return Member(session, table, None, trajectory)
    if not trajectory.usable().any():
        return Member(session, table, None, _why_unusable(trajectory, table))
    return Member(session, table, replace(trajectory.from_first_window(), medication_h=hours_since_dose(session)), None)


def _why_unusable(trajectory: SessionTrajectory, table: StepTable) -> str:
    if np.isnan(trajectory.beta).all():
        return "no usable step: no valid beta amplitude"
    if table.above_one == trajectory.steps:
        return "no usable step: every amplitude exceeds the cDBS amplitude"
    return (
        f"no usable step: none of its {trajectory.steps} steps has a whole beta window before it and an amplitude within the cDBS amplitude"
    )


def _signal(version: SettingsVersion, read: list[Member]) -> tuple[str, str]:
    """Return the one unit and source of beta for the buffer, as the settings state them.

    Raises:
        Invalid: they do not. A threshold without a unit judges no trace, and every reward rests on it.
    """
    unstated = [name for name, value in (("unit", version.beta_unit), ("source", version.beta_source)) if not value]
    if not unstated:
        return str(version.beta_unit), str(version.beta_source)
    kinds = Counter(f"{m.table.beta_trace.unit} from {m.table.beta_trace.source}" for m in read if m.table and m.table.beta_trace)
    raise Invalid(
        f"No person has stated the {' and the '.join(unstated)} of the threshold of {version.xi_beta:g} of participant "
        f"{version.participant.code}, so that no reward can be computed.",
        "State unit and source of beta in the participant's settings."
        + (f" The confirmed sessions have beta in {', '.join(f'{kind} ({n})' for kind, n in kinds.most_common(4))}." if kinds else ""),
    )


UNSTATED = "unstated"
"""Unit of a table's beta that neither the table nor the settings of its time named."""


def _admit(m: Member, unit: str, source: str) -> Member:
    """Leave out what is in another unit or from another source: beta amplitudes of two kinds are never mixed."""
    if m.trajectory is None or m.table is None or m.table.beta_trace is None:
        return m
    trace = m.table.beta_trace
    # A table that came before anyone had stated a unit is in the one that the settings state for tables now.
    stated = unit if (trace.unit, trace.source, source) == (UNSTATED, "table", "table") else trace.unit
    if (stated, trace.source) == (unit, source):
        return m
    reason = f"its beta is in {trace.unit} from {trace.source}; the participant's settings say {unit} from {source}"
    return Member(m.session, m.table, None, reason)


def _of_one_programming(members: list[Member], version: SettingsVersion) -> list[Member]:
    """Leave out sessions under other contacts, pulse widths or rates than the newest of their side: a fraction is another dose there."""
    if version.pool_programmings:
        return members
    newest: dict[Hemisphere | None, list[Program]] = {}
    for m in members:
        if m.programs:
            newest[m.session.hemisphere] = m.programs  # members come by visit and order
    found = []
    for m in members:
        differs = differences(m.programs, newest.get(m.session.hemisphere, ()), m.session.hemisphere) if m.trajectory else []
        found.append(Member(m.session, m.table, None, other_programming(differs)) if differs else m)
    return found


def _pass_gate(m: Member, barrier: Gate) -> Member:
    """Leave out sessions of learned policies while the gate is shut."""
    if m.trajectory is None or barrier.is_open or blinding.arm(m.session, SYSTEM).controller not in LEARNED:
        return m
    return Member(m.session, m.table, None, f"session of a learned policy, and these are not learned from: {gate_grounds(barrier)}")


def _row(snapshot_id: int, m: Member) -> SnapshotSession:
    table = m.table
    return SnapshotSession(
        snapshot_id=snapshot_id,
        session_id=m.session.id,
        beta_trace_id=table.beta_trace.id if table and table.beta_trace else None,
        amplitude_trace_id=table.amplitude_trace.id if table and table.amplitude_trace else None,
        decode_version=m.decode_version,
        qoc_id=m.session.qoc.id if m.session.qoc else None,
        conditions_id=m.session.conditions.id if m.session.conditions else None,
        cdbs_amplitude_ma=table.cdbs_ma if table else None,
        hours_since_dose=hours_since_dose(m.session),
        steps=m.steps,
        left_out_reason=m.left_out,
    )


def _digest(s: SessionTrajectory) -> str:
    """Hash a trajectory's numbers: this catches every change that the row numbers do not show, such as a moved segment."""
    digest = hashlib.sha256()
    for values in (s.lead_beta, s.beta, s.amplitude):
        digest.update(np.ascontiguousarray(values, dtype="<f8").tobytes() + b"|")
    digest.update(repr((s.random_bound, s.lead_amplitude, *s.holds)).encode())
    if s.stopped_as is not None:
        digest.update(f"|stopped as {s.stopped_as}".encode())
    return digest.hexdigest()


def other_programming(differs: Sequence[Difference]) -> str:
    """Say why a session is excluded that ran under another programming than the participant's newest."""
    parts = [f"{d.of} and not {d.other} on {f'the {d.hemisphere} ' if d.hemisphere else ''}program {d.program}" for d in differs]
    return (
        f"it ran under another programming than the participant's newest session: {'; '.join(parts)}. The same fraction is another dose "
        "there; a clinician may pool both in the settings"
    )
