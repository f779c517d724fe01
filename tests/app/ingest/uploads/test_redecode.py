"""Stored files read again by a newer decoder: sessions take what it gives, snapshots keep what they pin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select, update
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app.cli import app
from app.ingest.uploads import reading, recordings
from app.ingest.uploads import redecode as module
from app.ingest.uploads.redecode import redecode
from app.platform import files
from app.tables.recordings import Recording, Trace
from ml import formats
from ml.formats.recording import DECODE_VERSION, DecodedFile
from tests.app.ingest.conftest import device_zip, steady
from tests.app.ingest.uploads.test_outcomes_intake import GRASPS, qoc, tremor


def better_decoder(monkeypatch: pytest.MonkeyPatch, change: Any) -> None:
    """Give the decoder the next version from now on, with `change` applied to every trace."""

    def decode(path: Path, kind: Any, options: Any, name: str, *_: Any) -> DecodedFile:
        found = formats.decode(path, kind, options, name)
        return replace(found, recordings=tuple(replace(r, traces=tuple(t for t in map(change, r.traces) if t)) for r in found.recordings))

    monkeypatch.setattr(reading, "decode", decode)
    for holder in (module, recordings):
        monkeypatch.setattr(holder, "DECODE_VERSION", DECODE_VERSION + 1)


def doubled(trace: Any) -> Any:
    return replace(trace, values=(2 * trace.values).astype(np.float32)) if trace.stream == "beta" else trace


def all_of(**named: Any) -> list[Any]:
    return list(redecode(**({"participant_id": None, "upload_file_id": None, "dry_run": False, "actor": "test"} | named)))


def trace_of(client: TestClient, session_id: int) -> dict[str, Any]:
    return dict(client.get(f"/api/v1/sessions/{session_id}/trace").json())


def test_sessions_take_the_new_version_and_snapshots_keep_the_old(
    send: Any, client: TestClient, monkeypatch: pytest.MonkeyPatch, db: Session
) -> None:
    session = send(("t.csv", steady(0.5)), visit=1, controller="other").json()["sessions"][0]["id"]
    old_snapshot = client.post("/api/v1/participants/P1/snapshots").json()
    before = trace_of(client, session)
    better_decoder(monkeypatch, doubled)
    (change,) = all_of()
    assert change.state == "read again"
    assert f"version {DECODE_VERSION} to {DECODE_VERSION + 1}" in change.said[0]
    assert "beta table: 21 of 21 rows differ" in change.said[0]
    after = trace_of(client, session)
    assert (before["decode_version"], after["decode_version"]) == (DECODE_VERSION, DECODE_VERSION + 1)
    assert [b and 2 * b for b in before["beta"]] == after["beta"]
    assert client.get(f"/api/v1/snapshots/{old_snapshot['id']}").json() == old_snapshot
    new_snapshot = client.post("/api/v1/participants/P1/snapshots").json()
    pins = [s["members"][0]["beta_trace_id"] for s in (old_snapshot, new_snapshot)]
    versions = [db.get_one(Trace, i).decode_version for i in pins]
    assert versions == [DECODE_VERSION, DECODE_VERSION + 1]


def test_delivered_milliamperes_stay_what_they_were(send: Any, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    session = send(("t.csv", steady(0.5)), visit=1, controller="other").json()["sessions"][0]["id"]
    before = trace_of(client, session)["amplitude_ma"]
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 2.0}})
    better_decoder(monkeypatch, doubled)
    all_of()
    assert trace_of(client, session)["amplitude_ma"] == before
    assert before[-1] == pytest.approx(1.5)


def test_a_recording_that_was_stored_before_batteries_were_read_tells_its_battery_afterwards(
    send: Any, client: TestClient, db: Session
) -> None:
    send(("s.zip", device_zip()), visit=1, controller="cdbs")
    page = "/participants/P1/analyses/energy"
    (recording,) = db.scalars(select(Recording))
    told = recording.details["settings"]["battery"]
    recording.details = recording.details | {"settings": {k: v for k, v in recording.details["settings"].items() if k != "battery"}}
    db.execute(update(Trace).values(decode_version=6))
    db.commit()
    assert "Battery, measured" not in client.get(page).text
    done = CliRunner().invoke(app, ["ingest", "redecode", "--participant", "P1"])
    assert done.exit_code == 0, done.output
    assert "the same numbers" in done.output
    db.expire_all()
    assert recording.details["settings"]["battery"] == told == {"percent": 80.0, "voltage_v": 2.43}
    measured = client.get(page).text.split("Battery, measured")[1]
    assert [word in measured for word in ("80", "2.43")] == [True] * 2


def test_a_second_run_changes_nothing(send: Any, monkeypatch: pytest.MonkeyPatch, db: Session) -> None:
    send(("s.zip", device_zip()), ("t.csv", steady(1)))
    assert {c.state for c in all_of()} == {"up to date"}
    better_decoder(monkeypatch, doubled)
    assert {c.state for c in all_of()} == {"read again"}
    count = db.scalar(select(func.count()).select_from(Trace))
    assert {c.state for c in all_of()} == {"up to date"}
    db.expire_all()
    assert db.scalar(select(func.count()).select_from(Trace)) == count


def test_tremor_and_grasps_that_read_as_before_are_up_to_date(send: Any, client: TestClient) -> None:
    send(("s.zip", device_zip()), ("m.csv", tremor()), ("g.csv", GRASPS), visit=1, controller="random")
    for dry_run in (True, False):
        assert [(c.kind, c.state, c.said) for c in all_of(dry_run=dry_run)] == [(k, "up to date", []) for k in ("rcs", "tremor", "grasp")]


def test_minutes_that_the_decoder_reads_otherwise_are_told_and_count(
    send: Any, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = send(("s.zip", device_zip()), ("m.csv", tremor()), visit=1, controller="random").json()["sessions"][0]["id"]
    assert qoc(client, session)["tremor_percent"] == pytest.approx(25)
    real = reading.decode
    monkeypatch.setattr(reading, "decode", lambda *args, **named: more_tremor(real(*args, **named)))
    changes = {c.kind: c for c in all_of()}
    assert changes["tremor"].state == "read again"
    assert any("tremor 50 %" in s for s in changes["tremor"].said)
    assert qoc(client, session)["tremor_percent"] == pytest.approx(50)
    assert {c.state for c in all_of()} == {"up to date"}


def more_tremor(decoded: DecodedFile) -> DecodedFile:
    """Double the mild tremor, at the cost of none."""

    def change(log: Any) -> Any:
        fractions = log.fractions.copy()
        fractions[:, 1] -= fractions[:, 3]
        fractions[:, 3] *= 2
        return replace(log, fractions=fractions, any_tremor=fractions[:, 2:].sum(axis=1))

    return replace(decoded, outcomes=tuple(map(change, decoded.outcomes)))


def test_a_dry_run_tells_and_changes_nothing(send: Any, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    session = send(("t.csv", steady(1)), visit=1, controller="cdbs").json()["sessions"][0]["id"]
    before = trace_of(client, session)
    better_decoder(monkeypatch, doubled)
    assert [c.state for c in all_of(dry_run=True)] == ["read again"]
    assert trace_of(client, session) == before


def test_a_fault_in_one_file_does_not_stop_the_rest(send: Any, monkeypatch: pytest.MonkeyPatch, db: Session) -> None:
    answer = send(("a.csv", steady(1)), ("b.csv", steady(0)), visit=1).json()
    gone = answer["files"][0]["stored_sha256"]
    files.path_of(gone).write_bytes(b"damaged")
    better_decoder(monkeypatch, doubled)
    first, second = all_of()
    assert (first.state, second.state) == ("failed", "read again")
    assert "missing or damaged" in first.said[0]


def test_a_recording_whose_session_would_lose_its_control_trace_is_left_alone(
    send: Any, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = send(("t.csv", steady(1)), visit=1, controller="cdbs").json()["sessions"][0]["id"]
    before = trace_of(client, session)
    better_decoder(monkeypatch, lambda t: None if t.stream == "beta" else t)
    (change,) = all_of()
    assert change.state == "failed"
    assert f"session {session} would lose its control trace" in change.said[0]
    assert trace_of(client, session) == before


def test_only_the_named_participant_or_file_is_read(send: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = send(("a.csv", steady(1)), ("b.csv", steady(0)), visit=1).json()["files"][1]["id"]
    better_decoder(monkeypatch, doubled)
    assert [c.upload_file_id for c in all_of(upload_file_id=wanted)] == [wanted]
    assert all_of(participant_id=99) == []


def test_the_command_prints_what_changed_and_fails_where_a_file_failed(send: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = send(("a.csv", steady(1)), ("b.csv", steady(0)), visit=1).json()["files"]
    better_decoder(monkeypatch, doubled)
    told = CliRunner().invoke(app, ["ingest", "redecode", "--participant", "P1"])
    assert told.exit_code == 0, told.output
    assert "read again" in told.output
    files.path_of(stored[0]["stored_sha256"]).unlink()
    for holder in (module, recordings):
        monkeypatch.setattr(holder, "DECODE_VERSION", DECODE_VERSION + 2)
    failed = CliRunner().invoke(app, ["ingest", "redecode", "--json"])
    assert failed.exit_code == 1
    assert '"state": "failed"' in failed.output
    assert '"state": "read again"' in failed.output
