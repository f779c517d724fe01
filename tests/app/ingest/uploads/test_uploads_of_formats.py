"""Each format through the upload route: what arrives is cleaned, decoded and stored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from fastapi.testclient import TestClient

from app.platform import files


def upload(client: TestClient, content: bytes, name: str, **fields: Any) -> Any:
    """Post one file for P1, visit 1."""
    data = {"participant": "P1", "visit": "1", "controller": "other"} | {k: str(v) for k, v in fields.items()}
    return client.post("/api/v1/uploads", data=data, files={"file": (name, content)})


def stored_text(client: TestClient, body: Any) -> bytes:
    """The bytes of an upload's first file as they are kept."""
    kept = client.get(f"/api/v1/uploads/{body['id']}").json()["files"][0]
    return files.path_of(kept["stored_sha256"]).read_bytes()


def test_the_runs_of_a_percept_report_become_sessions_and_its_history_none(
    client: TestClient, participant_code: str, recordings: Path
) -> None:
    answer = upload(client, (recordings / "percept/percept_session_report.zip").read_bytes(), "report.zip")
    assert answer.status_code == 201, answer.json()
    body = answer.json()
    assert sorted(s["duration_s"] for s in body["sessions"])[-1] == 205.5
    assert len(body["sessions"]) <= 4
    trace = client.get(f"/api/v1/sessions/{body['sessions'][0]['id']}/trace").json()
    assert any(a == 0.0 for a in trace["amplitude_ma"])
    assert "PatientInformation" in repr(body["report"])


def test_a_report_of_history_alone_is_kept_and_makes_no_session(client: TestClient, participant_code: str, recordings: Path) -> None:
    body = upload(client, (recordings / "percept/group_history.json").read_bytes(), "history.json").json()
    assert body["sessions"] == []
    assert "nothing in it can be a session" in repr(body["report"])


def test_raw_lfp_becomes_a_session_whose_beta_is_of_the_time_domain(client: TestClient, participant_code: str) -> None:
    t = np.arange(1, 5001) / 250.0
    rows = "".join(f"{a:.3f},{3 * np.sin(2 * np.pi * 20 * a):.5f},1.5\n" for a in t)
    body = upload(client, ("t_s,lfp_uV,amplitude_ma\n" + rows).encode(), "lfp.csv").json()
    (session,) = body["sessions"]
    trace = client.get(f"/api/v1/sessions/{session['id']}/trace").json()
    beta = [b for b in trace["beta"] if b is not None]
    np.testing.assert_allclose(beta, 3 / np.sqrt(2), rtol=0.01)


def test_tremor_minutes_are_kept_without_who_wore_the_watch(client: TestClient, participant_code: str, recordings: Path) -> None:
    answer = upload(client, (recordings / "tremor/strivepd_long.csv").read_bytes(), "tremor.csv")
    assert answer.status_code == 201, answer.json()
    assert "10 minutes of tremor" in repr(answer.json()["report"])
    assert b"LARICRKw" not in stored_text(client, answer.json())


def test_a_grasp_test_is_kept(client: TestClient, participant_code: str) -> None:
    answer = upload(client, b"t_s,hand,name\n1,L,Jane\n1.5,L,Jane\n2,L,Jane\n", "grasp.csv")
    assert answer.status_code == 201, answer.json()
    assert "left hand: 3 open fists" in repr(answer.json()["report"])
    assert b"Jane" not in stored_text(client, answer.json())
