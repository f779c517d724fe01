"""Markers of a lab: asked on the session's page, explained once, applied to its recordings and to files that come later."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from app.ingest.uploads.redecode import redecode
from app.study import repository as study
from app.study.traces import unpack
from app.tables.recordings import Trace
from app.tables.sessions import StudySession
from tests.app.ingest.conftest import Send
from tests.conftest import PASSWORD
from tests.ml.formats.peers.xdf import Stream, write


def recording(path: Path, *texts: tuple[float, str], seed: int = 0, day: str = "2026-03-02", extra: tuple[Stream, ...] = ()) -> bytes:
    """Write an XDF file of 60 s with one LFP and markers."""
    t = np.arange(60 * 250) / 250
    x = 5 * np.sin(2 * np.pi * 20 * t)[:, None] + np.random.default_rng(seed).normal(0, 1, (t.size, 1))
    lfp = Stream("LFP", "LFP", 250.0, 100.0 + t, x, ["LFP L 0-2"], ["uV"])
    marks = Stream("Markers", "Markers", 0, np.array([100.0 + s for s, _ in texts]), [w for _, w in texts], form="string", per_chunk=1)
    write(path, [lfp, marks, *extra], date=f"{day}T11:00:00+0100")
    return path.read_bytes()


MARKS = ((2.0, "Plantedname cond A"), (30.0, "stim off"))


@pytest.fixture
def session_id(send: Send, tmp_path: Path) -> int:
    answer = send(("a.xdf", recording(tmp_path / "a.xdf", *MARKS)))
    assert answer.status_code == 201, answer.text
    (found,) = answer.json()["files"][0]["session_ids"]
    return int(found)


def doses(db: Session, session_id: int) -> list[float | None]:
    """Read the amplitudes of a session's recording as they count."""
    db.expire_all()
    (segment,) = db.get_one(StudySession, session_id).segments
    trace = next(t for t in study.traces_of_recording(db, segment.recording_id) if t.stream == "amplitude")
    return [None if np.isnan(v) else round(float(v), 3) for v in unpack(trace)]


def questions(client: TestClient, session_id: int) -> list[dict[str, Any]]:
    return list(client.get(f"/api/v1/sessions/{session_id}/markers").json()["questions"])


def explain(client: TestClient, session_id: int, key: str, **meaning: Any) -> Any:
    return client.put(f"/api/v1/sessions/{session_id}/markers", json={"meanings": [{"key": key, **meaning}]})


def test_a_meaning_is_stated_once_and_read_by_this_recording_and_later_files(
    client: TestClient, session_id: int, send: Send, tmp_path: Path, db: Session
) -> None:
    assert doses(db, session_id)[2:14] == [None] * 12
    (question,) = questions(client, session_id)
    assert (question["shown"], question["count"], question["meaning"]) == ("… a", 1, None)
    answer = explain(client, session_id, question["key"], means="amplitude", amplitude_ma=2.5)
    assert answer.status_code == 200, answer.text
    assert "as markers and channels are explained now" in answer.json()["said"][0]
    assert answer.json()["questions"][0]["meaning"] == {"means": "amplitude", "amplitude_ma": 2.5}
    assert doses(db, session_id)[2:14] == [2.5] * 12
    assert doses(db, session_id)[16:] == [0.0] * 14
    assert db.scalar(select(func.max(Trace.reading))) == 2, "traces of before stay, for snapshots pin them"
    later = send(("b.xdf", recording(tmp_path / "b.xdf", (4.0, "PLANTEDNAME cond a"), seed=1, day="2026-03-03")))
    (second,) = later.json()["files"][0]["session_ids"]
    assert doses(db, second)[3:] == [2.5] * 27
    assert questions(client, second)[0]["stated_by"]
    assert db.scalar(text("select count(*) from signal_meaning")) == 1


def test_a_meaning_that_ends_makes_the_dose_unknown_again_and_the_trail_has_both(client: TestClient, session_id: int, db: Session) -> None:
    key = questions(client, session_id)[0]["key"]
    explain(client, session_id, key, means="amplitude", amplitude_ma=2.5)
    explain(client, session_id, key, means=None)
    assert doses(db, session_id)[2:14] == [None] * 12
    assert questions(client, session_id)[0]["meaning"] is None
    assert db.scalar(text("select count(*) from audit_event where entity = 'signal_meaning'")) == 2
    with pytest.raises(Exception, match="signal_meaning"):
        db.execute(text("update signal_meaning set shown = 'x'"))


def test_files_that_came_before_are_read_by_it_at_once_and_others_stay_as_they_are(
    client: TestClient, session_id: int, send: Send, tmp_path: Path, db: Session
) -> None:
    other = send(("b.xdf", recording(tmp_path / "b.xdf", *MARKS, seed=1, day="2026-03-03"))).json()["files"][0]["session_ids"][0]
    apart = send(("c.xdf", recording(tmp_path / "c.xdf", (4.0, "stim 1 mA"), seed=2, day="2026-03-04"))).json()["files"][0]["session_ids"][
        0
    ]
    assert doses(db, other)[2:14] == [None] * 12
    answer = explain(client, session_id, questions(client, session_id)[0]["key"], means="amplitude", amplitude_ma=2.5)
    assert len([s for s in answer.json()["said"] if "as markers and channels are explained now" in s]) == 2
    assert doses(db, other)[2:14] == [2.5] * 12
    assert doses(db, apart)[3:] == [1.0] * 27
    assert all(c.state == "up to date" for c in redecode(None, None, False, "test"))


def test_what_cannot_be_meant_is_refused_and_nothing_is_stored(client: TestClient, session_id: int, db: Session) -> None:
    key = questions(client, session_id)[0]["key"]
    for wrong in ({"means": "amplitude"}, {"means": "amplitude", "amplitude_ma": 30}, {"means": "unit", "unit": "mA"}, {"means": "louder"}):
        assert explain(client, session_id, key, **wrong).status_code == 422
    assert explain(client, session_id, "marker of another lab", means="off").status_code == 422
    assert db.scalar(text("select count(*) from signal_meaning")) == 0


def test_a_recording_of_a_locked_visit_is_not_read_again(client: TestClient, send: Send, tmp_path: Path, db: Session) -> None:
    answer = send(("a.xdf", recording(tmp_path / "a.xdf", *MARKS)), visit=1, controller="random")
    (session_id,) = answer.json()["files"][0]["session_ids"]
    key = questions(client, session_id)[0]["key"]
    visit = db.get_one(StudySession, session_id).visit.id
    assert client.post(f"/api/v1/visits/{visit}/lock", json={"reason": "done", "password": PASSWORD}).status_code == 200
    refused = explain(client, session_id, key, means="off")
    assert refused.status_code == 409
    assert "was locked by" in refused.json()["detail"]
    assert db.scalar(text("select count(*) from signal_meaning")) == 0


def test_the_form_explains_a_marker_and_comes_back_with_what_is_wrong(client: TestClient, session_id: int, db: Session) -> None:
    browser = TestClient(client.app, headers={"Accept": "text/html"}, follow_redirects=False)
    assert browser.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD}).status_code == 303
    page = browser.get(f"/sessions/{session_id}/markers").text
    assert "… a" in page
    assert "Plantedname" not in page
    assert f'href="/sessions/{session_id}/markers"' in browser.get(f"/proposals/{session_id}").text
    wrong = browser.post(f"/sessions/{session_id}/markers", data={"means-0": "amplitude", "amplitude-0": ""})
    assert wrong.status_code == 422
    done = browser.post(f"/sessions/{session_id}/markers", data={"means-0": "amplitude", "amplitude-0": "2.5"})
    assert done.status_code == 303, done.text
    assert doses(db, session_id)[2:14] == [2.5] * 12


def test_a_gyroscope_gives_the_session_its_tremor_once_its_lever_is_stated(
    client: TestClient, send: Send, tmp_path: Path, db: Session
) -> None:
    t = np.arange(60 * 50) / 50
    turned = np.degrees(2 * np.pi * 5.0 * 0.01 / 0.15 * np.cos(2 * np.pi * 5.0 * t))[:, None]
    gyroscope = Stream("Wrist", "Gyroscope", 50.0, 100.0 + t, turned, ["gyro x L"], ["deg/s"])
    first = recording(tmp_path / "a.xdf", (2.0, "stim on 2.0 mA"), extra=(gyroscope,))
    answer = send(("a.xdf", first), visit=1, controller="random")
    (session_id,) = answer.json()["files"][0]["session_ids"]
    assert db.get_one(StudySession, session_id).qoc is None
    (question,) = questions(client, session_id)
    assert explain(client, session_id, question["key"], means="lever", lever_cm=15).status_code == 200
    db.expire_all()
    qoc = db.get_one(StudySession, session_id).qoc
    assert qoc is not None
    assert qoc.tremor_percent == pytest.approx(100.0, abs=7)
    later = send(("b.xdf", recording(tmp_path / "b.xdf", (2.0, "stim on 2.0 mA"), seed=1, day="2026-03-02", extra=(gyroscope,))))
    assert later.status_code == 201


def test_the_opening_of_a_hand_gives_its_session_the_grasp_frequency(client: TestClient, send: Send, tmp_path: Path, db: Session) -> None:
    t = np.arange(60 * 50) / 50
    opening = np.where((t > 40) & (t < 49.9), 5 + 3 * np.sin(2 * np.pi * 2.5 * t), 2.0)[:, None]
    hand = Stream("Hand", "Mocap", 50.0, 100.0 + t, opening, ["hand opening R"], [""])
    answer = send(("a.xdf", recording(tmp_path / "a.xdf", (2.0, "stim on 2.0 mA"), extra=(hand,))), visit=1, controller="random")
    (session_id,) = answer.json()["files"][0]["session_ids"]
    qoc = db.get_one(StudySession, session_id).qoc
    assert qoc is not None
    assert qoc.grasp_hz == pytest.approx(2.5, abs=0.03)
