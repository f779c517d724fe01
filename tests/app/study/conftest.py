"""Sessions with a known start, and uploaded files of a watch and a hand tracker as the ingest phase hands them over."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime

import numpy as np
import pytest
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.study import blinding, repository, visits
from app.study import participation as enrolment
from app.study.participation import ParticipantIn
from app.study.schemas import VisitIn
from app.study.settings_types import SettingsIn
from app.study.traces import pack
from app.tables.participants import Hemisphere
from app.tables.recordings import Device, Recording, Trace
from app.tables.sessions import Controller, SessionSegment, StudySession
from app.tables.uploads import Upload, UploadFile

START = datetime(2026, 3, 2, 9, 0, tzinfo=UTC)
CLASSES = ("unknown", "none", "slight", "mild", "moderate", "strong")


@pytest.fixture
def study_session(db: Session) -> StudySession:
    """A confirmed session of 10 minutes from 09:00 UTC on, of the left hemisphere, at half of a cDBS amplitude of 3 mA."""
    settings = SettingsIn(xi_beta=1.0, cdbs_amplitude_ma=3.0, beta_unit="uV", beta_source="table")
    participant = enrolment.enrol(db, ParticipantIn(code="P1", settings=settings), SYSTEM)
    visit = visits.add_visit(db, participant, VisitIn(number=1, date=START.date()), SYSTEM)
    device = Device(participant_id=participant.id, pseudonym="d", kind="rcs")
    db.add(device)
    db.flush()
    recording = Recording(
        participant_id=participant.id, device_id=device.id, fingerprint="f" * 64, clock="pc", started_at=START, duration_s=600.0, details={}
    )
    recording.device = device
    session = StudySession(visit_id=visit.id, ordinal=1, hemisphere=Hemisphere.LEFT, started_at=START, duration_s=600.0)
    session.segments.append(SessionSegment(recording=recording, start_s=0.0, stop_s=600.0))
    blinding.assign(session, Controller.CDBS, None)
    db.add_all([recording, session])
    db.flush()
    for stream, unit, level in (("beta", "uV", 1.2), ("amplitude", "mA", 1.5)):
        values, valid = pack(np.full(300, level), np.ones(300, dtype=bool))
        source = "table" if stream == "beta" else "device_log"
        db.add(
            Trace(
                recording_id=recording.id, decode_version=1, stream=stream, channel="", unit=unit, source=source, dt_s=2.0, first_end_s=2.0,
                n=300, values_f32=values, valid_bits=valid,
            )
        )  # fmt: skip
    db.commit()
    return repository.session(db, session.id, SYSTEM)


@pytest.fixture
def new_file(db: Session) -> Callable[[StudySession], int]:
    """Number of a new upload file of the session's participant."""

    def make(session: StudySession) -> int:
        participant_id = session.visit.participant_id
        upload = Upload(participant_id=participant_id, stated={}, created_by="test")
        db.add(upload)
        db.flush()
        file = UploadFile(
            upload_id=upload.id, participant_id=participant_id, name="f", size=1, original_sha256=f"{upload.id:064d}", report={}
        )
        db.add(file)
        db.flush()
        return file.id

    return make


def minutes(
    shares: Sequence[dict[str, float]], first_min: float = 0.0, length_s: float = 60.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Build minutes one after another from `first_min` after the session's start; what a minute's shares leave is `none`."""
    fractions = np.array([[{"none": 1 - sum(s.values()), **s}.get(c, 0.0) for c in CLASSES] for s in shares]).reshape(-1, len(CLASSES))
    start = START.timestamp() + 60 * first_min + 60.0 * np.arange(len(shares))
    return start, np.full(len(shares), length_s), fractions, fractions[:, 2:].sum(axis=1)
