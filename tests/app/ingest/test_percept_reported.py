"""Reports as public ones are, through the upload route: the amplitude that was on, and the moment at which it was."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app.cli import app
from app.study.traces import unpack
from app.tables.recordings import Recording, Trace


@pytest.fixture
def report(recordings: Path) -> Any:
    """Reads a file of the reported ones."""
    folder = recordings / "reported"
    if not folder.is_dir():
        pytest.skip("the reported files are not among the recordings here")
    return lambda name: (name, (folder / name).read_bytes())


def time_of(text: str) -> datetime:
    """Parse a time of an answer."""
    return datetime.fromisoformat(text)


def sentences(answer: Any) -> str:
    """Join all that the answer's reports flag."""
    return "\n".join(s for r in answer.json()["report"] for s in r["flagged"])


def traces(db: Session, recording_id: int) -> dict[str, Any]:
    """Unpack the values of each stream of a recording, gaps as NaN."""
    return {t.stream: unpack(t) for t in db.scalars(select(Trace).where(Trace.recording_id == recording_id))}


def runs(db: Session) -> list[Recording]:
    """List the recordings that can be sessions, by start."""
    found = db.scalars(select(Recording).order_by(Recording.started_at, Recording.id))
    return [r for r in found if r.details.get("run") is not None]


def test_power_whose_ticks_turned_keeps_its_samples(send: Any, report: Any, db: Session) -> None:
    answer = send(report("01-power-ticks-begin-anew.json"))
    assert answer.status_code == 201, answer.text
    assert [[u["usable"] for u in p["usable_steps"] if u["stream"] == "beta"] for p in answer.json()["proposals"]] == [[19]] * 3
    assert [sorted(traces(db, r.id)) for r in runs(db)] == [["amplitude", "band_power", "beta", "beta_power"]] * 3
    for recording, amplitude in zip(runs(db), (1.0, 1.5, 2.0), strict=True):
        values = traces(db, recording.id)["amplitude"]
        assert {round(float(v), 3) for v in values[values == values]} == {amplitude}
    assert "amplitude" not in sentences(answer)
    assert "copies" not in answer.text


def test_an_implants_clock_is_corrected_and_its_tremor_found(send: Any, report: Any, client: TestClient) -> None:
    answer = send(report("02-implant-clock-ahead.json"), report("02-implant-clock-ahead-tremor.csv"), visit=1, controller="cdbs")
    assert answer.status_code == 201, answer.text
    (session,) = answer.json()["sessions"]
    assert abs((time_of(session["started_at"]) - time_of("2026-03-05T22:04:58Z")).total_seconds()) <= 60
    assert "37 min 34 s ahead of UTC" in sentences(answer)
    found = client.get(f"/api/v1/sessions/{session['id']}/qoc").json()
    assert found["tremor_percent"] == pytest.approx(60.0, abs=0.5), found


def test_two_implants_of_one_person_are_one_session(send: Any, report: Any) -> None:
    answer = send(report("03-two-implants-left.json"), report("03-two-implants-right.json"))
    assert answer.status_code == 201, answer.text
    (proposal,) = answer.json()["proposals"]
    assert time_of(proposal["session"]["started_at"]) == time_of("2026-03-12T16:10:00Z")


def test_two_implants_in_two_uploads_are_one_session(send: Any, report: Any, proposals: Any, db: Session) -> None:
    send(report("03-two-implants-left.json"))
    send(report("03-two-implants-right.json"))
    assert len(proposals()) == 1
    assert [r.hemisphere for r in sorted(runs(db), key=lambda r: r.hemisphere or "")] == ["left", "right"]


def test_a_power_that_is_no_reading_is_a_gap(send: Any, report: Any, db: Session) -> None:
    answer = send(report("04-invalid-power-reading.json"))
    (recording,) = runs(db)
    values = traces(db, recording.id)["band_power"]
    known = values[values == values]
    # rows 22 s and 62 s have the five void values: what is left of them, or nothing
    assert [bool(v != v or 540 <= v <= 720) for v in values] == [True] * 60
    assert (known.size >= 58, known.min() >= 540, known.max() <= 720) == (True, True, True)
    history = db.scalars(select(Recording)).all()[-1]
    power = [p for p in history.details["settings"]["trends"]["left"]["power_device_units"] if p is not None]
    assert (len(power), min(power) >= 600, max(power) <= 800) == (285, True, True)
    assert "5 values of LFP" in sentences(answer)
    assert "trends: 3 values" in sentences(answer)


def test_the_devices_history_has_its_states_and_the_lead_its_target(send: Any, report: Any, proposals: Any, client: TestClient) -> None:
    answer = send(report("07-real-enumerations.json"))
    assert answer.status_code == 201, answer.text
    history = client.get("/api/v1/participants/P1/device-history").text
    shown = ("recharge started", "recharge ended", "therapy off", "active group A to C", "therapy on", "impedance good")
    assert [text for text in shown if text not in history] == []
    assert "whose target the recording does not tell" not in repr(proposals())
    assert "left STN" in repr(proposals())


def test_power_that_is_dated_apart_is_a_run_of_its_own(send: Any, report: Any, db: Session) -> None:
    send(report("12-power-of-another-run.json"))
    first, second = runs(db)
    assert first.started_at is not None
    assert second.started_at is not None
    assert (first.started_at, sorted(traces(db, first.id))) == (time_of("2026-03-13T15:10:00Z"), ["beta", "beta_power"])
    assert (second.started_at, sorted(traces(db, second.id))) == (time_of("2026-03-13T15:40:00Z"), ["amplitude", "band_power"])


def test_loss_of_indefinite_streaming_is_told(send: Any, report: Any) -> None:
    said = sentences(send(report("14-indefinite-third-lost.json")))
    assert [f"{c}: 33.3 % of the samples are missing" in said for c in ("ZERO_THREE_LEFT", "ONE_THREE_LEFT")] == [True, True]


def test_names_that_no_decoder_knows_are_listed_for_the_installation(send: Any, report: Any) -> None:
    name, content = report("07-real-enumerations.json")
    made = json.loads(content)
    entry = {"DateTime": "2026-03-05T15:08:00Z", "TherapyStatus": "TherapyChangeStatusDef.SuspendedByZebra"}
    made["DiagnosticData"]["EventLogs"].append(entry)
    assert send((name, json.dumps(made).encode())).status_code == 201
    listed = json.loads(CliRunner().invoke(app, ["ingest", "names", "--json"]).stdout)["names"]
    assert [(n["device"], n["name"], n["recordings"], n["devices"]) for n in listed] == [
        ("percept", "therapy status: TherapyChangeStatusDef.Suspended…", 1, 1)
    ]
    shown = CliRunner().invoke(app, ["ingest", "names"]).stdout
    assert "therapy" in shown
    assert "Zebra" not in shown


def test_an_installation_without_unknown_names_says_so(send: Any, report: Any) -> None:
    send(report("07-real-enumerations.json"))
    assert "No device's file had a name" in CliRunner().invoke(app, ["ingest", "names"]).stdout
