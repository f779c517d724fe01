"""A participant with sessions, a snapshot, policies and a ranking, made by the phases that make them in a study."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.estimates.service import store_evaluation
from app.learning.snapshots import take_snapshot
from app.platform import files
from app.study import blinding
from app.study.repository import participant_by_code
from app.study.traces import pack
from app.tables.learning import BufferSnapshot, Policy
from app.tables.outcomes import QocRevision
from app.tables.participants import Participant
from app.tables.recordings import Device, Recording, Trace
from app.tables.sessions import Controller, SessionSegment, StudySession
from app.tables.visits import Visit
from ml.ope.estimate import Estimate
from ml.ope.flags import Flag


@dataclass(frozen=True)
class Studied:
    """Ids of what a plan is made from; visit 2 is open, visit 1 has sessions."""

    visit: int
    held_visit: int
    evaluation: int
    policies: tuple[int, ...]
    unsupported: int
    retired: int


def _hold(db: Session, participant: Participant, visit: Visit, ordinal: int) -> None:
    session = StudySession(visit_id=visit.id, ordinal=ordinal, duration_s=120.0)
    blinding.assign(session, Controller.CDBS, None)
    device = Device(participant_id=participant.id, pseudonym=f"d{ordinal}", kind="table")
    db.add_all([session, device])
    db.flush()
    recording = Recording(
        participant_id=participant.id, device_id=device.id, fingerprint=f"{visit.id}-{ordinal}", clock="table", duration_s=140, details={}
    )
    db.add(recording)
    db.flush()
    db.add(SessionSegment(session_id=session.id, recording_id=recording.id, start_s=0.0, stop_s=120.0))
    db.add(QocRevision(session_id=session.id, revision=1, grasp_hz=2.0, rating=8, tremor_percent=5.0, entered_by="test"))
    for stream, unit, values in (("beta", "uV", np.linspace(1, 2, 70)), ("amplitude", "fraction", np.ones(70))):
        packed, valid = pack(values, np.ones(70, dtype=bool))
        db.add(
            Trace(
                recording_id=recording.id,
                decode_version=1,
                stream=stream,
                unit=unit,
                source="table",
                dt_s=2.0,
                first_end_s=-18.0,
                n=70,
                values_f32=packed,
                valid_bits=valid,
            )
        )
    db.flush()


def _policy(
    db: Session, participant: Participant, snapshot: BufferSnapshot | None, name: str, kind: str, teacher: int | None = None
) -> Policy:
    row = Policy(
        participant_id=participant.id,
        name=name,
        kind=kind,
        algorithm="ddpg" if kind == "trained" else kind,
        teacher_id=teacher,
        snapshot_id=snapshot.id if snapshot else None,
        settings_version_id=participant.current_settings.id,
        config={},
        onnx_sha256=files.store(db, name.encode()).sha256,
        metrics={},
        code_version="test",
        created_by="test",
    )
    db.add(row)
    db.flush()
    return row


def _estimate(value: float, energy: float, supported: bool = True) -> dict[str, object]:
    return Estimate(
        method="dlsm",
        value=value,
        low=value - 2,
        high=value + 1.5,
        level=0.9,
        standard_error=1.0,
        step_return=value - 90,
        end_reward=90.0,
        predicted={"energy": energy},
        supported=supported,
        flags=() if supported else (Flag.of("text", text="far from the data"),),
        n=10,
        details={},
    ).to_json()


@pytest.fixture
def study_world(db: Session, participant_code: str) -> Studied:
    """P1 after a visit, with four ranked policies (one of them not supported by the data), a retired one and one made elsewhere."""
    participant = participant_by_code(db, participant_code, SYSTEM)
    held = participant.visits[0]
    for ordinal in (1, 2):
        _hold(db, participant, held, ordinal)
    visit = Visit(participant_id=participant.id, number=2, date=None)
    db.add(visit)
    db.flush()
    db.commit()  # as in a study: what a snapshot rests on was written before its transaction began
    snapshot = take_snapshot(db, participant, SYSTEM)
    trained = [_policy(db, participant, snapshot, f"rl-0{i}", "trained") for i in (1, 2)]
    students = [_policy(db, participant, snapshot, f"{t.name}-small", "distilled", t.id) for t in trained]
    ranked = [*trained, *students]
    estimates = {str(p.id): _estimate(95.0 - i, 0.4 + 0.1 * i, supported=i < 3) for i, p in enumerate(ranked)}
    evaluation = store_evaluation(
        db,
        job_id=None,
        created_by="test",
        snapshot=snapshot,
        horizon_steps=60,
        candidates=[p.id for p in ranked],
        results={"dlsm": {"estimates": estimates}},
        config={},
    )
    retired = _policy(db, participant, snapshot, "rl-00", "trained")
    retired.retired_reason = "dyskinesia at visit 1"
    db.commit()
    return Studied(visit.id, held.id, evaluation.id, tuple(p.id for p in ranked), students[1].id, retired.id)


@pytest.fixture
def external(db: Session, study_world: Studied) -> int:
    """Id of a policy made elsewhere, which no ranking holds."""
    row = _policy(db, participant_by_code(db, "P1", SYSTEM), None, "β-Regler „Łódź“", "external")
    db.commit()
    return row.id
