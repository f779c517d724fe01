"""A recording without a known start among dated ones of its device: it shares no minutes with any of them."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import inspect, select
from sqlalchemy.orm import Session

from app.ingest.repository import recordings_of_minutes
from app.study.sessions.repository import same_minutes
from app.tables.recordings import Recording
from app.tables.sessions import SessionSegment
from tests.app.ingest.conftest import device_zip


def test_a_recording_without_a_start_shares_no_minutes(send: Any, db: Session) -> None:
    send(("rcs.zip", device_zip()), visit=1, controller="random")
    dated = db.scalars(select(Recording).where(Recording.started_at.is_not(None))).first()
    assert dated is not None
    segment = db.scalars(select(SessionSegment).where(SessionSegment.recording_id == dated.id, SessionSegment.is_control)).one()
    columns = {c.key: getattr(dated, c.key) for c in inspect(Recording).column_attrs if c.key not in {"id", "started_at", "fingerprint"}}
    undated = Recording(**columns, started_at=None, fingerprint="0" * 64)
    db.add(undated)
    db.flush()
    assert recordings_of_minutes(db, dated) == [dated]
    assert dated.started_at is not None
    end = dated.started_at + timedelta(seconds=dated.duration_s)
    segment.recording = undated
    db.flush()
    assert same_minutes(db, dated, dated.started_at, end, None) == []


def test_a_dated_report_after_an_undated_one_of_its_device_is_read(send: Any, recordings: Path) -> None:
    names = ("05a-undated-first.json", "05b-dated-second.json")
    if not (recordings / "reported" / names[0]).exists():
        pytest.skip("the reported files are not among the recordings here")
    for name in names:
        answer = send((name, (recordings / "reported" / name).read_bytes()))
        assert answer.status_code == 201, answer.text
        assert answer.json()["proposals"], answer.text
