"""Recordings of any lab through the upload route: cleaned, decoded, and one session per file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from tests.app.ingest.uploads.test_uploads_of_formats import stored_text, upload
from tests.ml.formats.brainvision.test_brainvision import three
from tests.ml.formats.peers.xdf import Stream, write

NAME = "Plantedname"


def xdf_file(path: Path) -> bytes:
    """Write LFP of both sides and markers, with a person's name wherever a recorder has a place for one."""
    t = 100.0 + np.arange(15_000) / 250
    x = np.random.default_rng(0).normal(0, 2, (t.size, 2))
    marks = [(110.0, "stim on 2.5 mA"), (120.0, f"{NAME} feels well"), (150.0, "stim off")]
    text = Stream("Markers", "Markers", 0, np.array([m[0] for m in marks]), [m[1] for m in marks], form="string", per_chunk=1)
    said = f"<hostname>{NAME}</hostname><source_id>{NAME}</source_id>"
    write(path, [Stream(f"{NAME} amp", "LFP", 250.0, t, x, ["STN L 1-3", "STN R 1-3"], ["uV", "uV"], extra=said), text])
    return path.read_bytes()


FILES = {"xdf": xdf_file}


@pytest.mark.parametrize("kind", sorted(FILES))
def test_a_lab_s_recording_is_one_session_of_both_sides_without_a_name(
    kind: str, client: TestClient, participant_code: str, tmp_path: Path
) -> None:
    answer = upload(client, FILES[kind](tmp_path / "file"), f"{NAME}.{kind}", hemisphere="left")
    assert answer.status_code == 201, answer.json()
    body: dict[str, Any] = answer.json()
    (session,) = body["sessions"]
    assert session["hemisphere"] == "left"
    trace = client.get(f"/api/v1/sessions/{session['id']}/trace").json()
    known = [a for a in trace["amplitude_ma"] if a is not None]
    assert known.count(2.5) == 20 or known.count(2.5) == 19
    assert known.count(0.0) in (4, 5)
    assert trace["amplitude_ma"][0] is None
    assert sum(b is not None for b in trace["beta"]) >= 29
    assert NAME.encode() not in stored_text(client, body)
    assert NAME not in repr(client.get(f"/api/v1/uploads/{body['id']}").json())


def test_three_loose_files_of_one_recording_are_put_together(client: TestClient, participant_code: str) -> None:
    files = [("file", (name, content)) for name, content in three().items()]
    data = {"participant": "P1", "visit": "1", "controller": "other"}
    answer = client.post("/api/v1/uploads", data=data, files=files)
    assert answer.status_code == 201, answer.json()
    assert [s["duration_s"] for s in answer.json()["sessions"]] == [40.0]


def test_a_recording_without_its_marker_file_waits_encrypted_with_what_to_send(client: TestClient, participant_code: str) -> None:
    files = [("file", (name, content)) for name, content in three().items() if not name.endswith(".vmrk")]
    answer = client.post("/api/v1/uploads", data={"participant": "P1"}, files=files)
    said = repr(answer.json())
    assert "no gap can be seen" in said
    assert ".vhdr, .vmrk and .eeg" in said
