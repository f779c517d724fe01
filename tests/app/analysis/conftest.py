"""Sessions with traces and QoCs, written straight to the store."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.study import blinding, repository
from app.study.models import Controller, Device, Hemisphere, QocRevision, Recording, SessionSegment, StudySession, Trace
from app.study.traces import pack

AddSession = Callable[..., int]


@pytest.fixture
def add_session(db: Session, enrolled: str) -> AddSession:
    """Add a session of 300 s to visit 1 of P1: constant beta and amplitude fraction, QoCs; None leaves a thing out. Returns its id."""
    participant = repository.participant_by_code(db, enrolled, SYSTEM)
    device = Device(participant_id=participant.id, pseudonym="d", kind="table")
    db.add(device)
    db.flush()
    visit_id = participant.visits[0].id

    def add(
        controller: str,
        beta: float | list[float] | None = 2.0,
        fraction: float | list[float] | None = 1.0,
        grasp: float | None = None,
        rating: int | None = None,
        tremor: float | None = None,
        unit: str = "uV",
        source: str = "table",
        excluded: str | None = None,
        status: str = "confirmed",
        hemisphere: str | None = None,
        duration_s: float = 300.0,
    ) -> int:
        ordinal = repository.next_ordinal(db, visit_id)
        session = StudySession(
            visit_id=visit_id,
            ordinal=ordinal,
            duration_s=duration_s,
            excluded_reason=excluded,
            status=status,
            hemisphere=Hemisphere(hemisphere) if hemisphere else None,
        )
        blinding.assign(session, Controller(controller), None)
        recording = Recording(
            participant_id=participant.id, device_id=device.id, fingerprint=f"f{ordinal}", clock="table", duration_s=duration_s, details={}
        )
        db.add_all([session, recording])
        db.flush()
        db.add(SessionSegment(session_id=session.id, recording_id=recording.id, start_s=0.0, stop_s=max(duration_s, 1.0)))
        steps = int(duration_s // 2)
        for stream, values, named, origin in (("beta", beta, unit, source), ("amplitude", fraction, "fraction", "table")):
            if values is None:
                continue
            array = np.broadcast_to(np.asarray(values, dtype=float), (steps,)).copy()
            packed, valid = pack(array, ~np.isnan(array))
            db.add(
                Trace(
                    recording_id=recording.id,
                    decode_version=1,
                    stream=stream,
                    unit=named,
                    source=origin,
                    dt_s=2.0,
                    first_end_s=2.0,
                    n=steps,
                    values_f32=packed,
                    valid_bits=valid,
                )
            )
        if not (grasp is None and rating is None and tremor is None):
            db.add(QocRevision(session_id=session.id, revision=1, grasp_hz=grasp, rating=rating, tremor_percent=tremor, entered_by="test"))
        db.commit()
        return session.id

    return add
