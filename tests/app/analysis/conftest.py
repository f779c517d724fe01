"""Sessions with traces and QoCs, written straight to the store."""

from __future__ import annotations

from collections.abc import Callable
from datetime import date, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.study import blinding, repository
from app.study.traces import pack
from app.tables.outcomes import QocRevision
from app.tables.participants import Hemisphere
from app.tables.recordings import Device, Recording, Trace
from app.tables.sessions import Controller, SessionSegment, StudySession
from app.tables.visits import Visit

AddSession = Callable[..., int]


@pytest.fixture
def add_session(db: Session, participant_code: str) -> AddSession:
    """Function that adds a session of 300 s to a visit of P1: constant beta and amplitude fraction, QoCs; None omits one. It returns the
    id.
    """
    return adder(db, participant_code)


def adder(db: Session, code: str) -> AddSession:
    """Return a function that adds sessions to a participant."""
    participant = repository.participant_by_code(db, code, SYSTEM)
    device = Device(participant_id=participant.id, pseudonym="d", kind="table")
    db.add(device)
    visits = {v.number: v.id for v in participant.visits}
    db.commit()  # the next transaction begins with the first session, whose record is dated by it

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
        visit: int = 1,
        policy_id: int | None = None,
        stopped: str | None = None,
        medication_h: float | None = None,
        started_at: datetime | None = None,
    ) -> int:
        if visit not in visits:
            row = Visit(participant_id=participant.id, number=visit, date=date(2026, 3, 2) + timedelta(days=28 * (visit - 1)))
            db.add(row)
            db.flush()
            visits[visit] = row.id
        visit_id = visits[visit]
        ordinal = repository.next_ordinal(db, visit_id)
        session = StudySession(
            visit_id=visit_id,
            ordinal=ordinal,
            duration_s=duration_s,
            excluded_reason=excluded,
            status=status,
            hemisphere=Hemisphere(hemisphere) if hemisphere else None,
            stopped_reason=stopped,
            medication_h=medication_h,
            started_at=started_at,
        )
        blinding.assign(session, Controller(controller), policy_id)
        name = f"f{visit}.{ordinal}"
        recording = Recording(
            participant_id=participant.id, device_id=device.id, fingerprint=name, clock="table", duration_s=duration_s, details={}
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


@pytest.fixture
def add_visits(add_session: AddSession) -> Callable[..., None]:
    """Visits of three cDBS and three sessions of a controller each, in turn; the days differ, the controller saves half of the energy."""

    def add(visits: int = 6, first: int = 1, controller: str = "rl", grasp: float = 0.0, seed: int = 7, **fields: Any) -> None:
        rng = np.random.default_rng(seed)
        for visit in range(first, first + visits):
            day = rng.normal(0, 0.3, 3)
            for k in range(6):
                tested = k % 2 == 1
                add_session(
                    controller if tested else "cdbs",
                    beta=2.0 + day[0] + 0.1 * rng.normal(),
                    fraction=(0.7 if tested else 1.0) * (1 - 0.02 * rng.random()),
                    grasp=2.4 + day[1] + 0.08 * rng.normal() + (grasp if tested else 0.0),
                    rating=int(np.clip(round(7 + day[2] + 0.6 * rng.normal()), 1, 10)),
                    tremor=float(np.clip(12 + 4 * day[0] + 2 * rng.normal(), 0, 100)),
                    visit=visit,
                    **({name: value for name, value in fields.items() if tested}),
                )

    return add
