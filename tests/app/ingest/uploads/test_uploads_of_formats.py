"""Each format through the upload route: what arrives is cleaned, decoded and stored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import edfio
import numpy as np
import pynwb
import pytest
from fastapi.testclient import TestClient
from pynwb.ecephys import ElectricalSeries

from app.platform import files
from tests.ml.formats.brainvision.test_brainvision import three
from tests.ml.formats.peers import bids, nwb
from tests.ml.formats.peers.xdf import Stream, write


def upload(client: TestClient, content: bytes, name: str, **fields: Any) -> Any:
    """Post one file for P1, visit 1."""
    data = {"participant": "P1", "visit": "1", "controller": "other"} | {k: str(v) for k, v in fields.items()}
    return client.post("/api/v1/uploads", data=data, files={"file": (name, content)})


def stored_text(client: TestClient, body: Any) -> bytes:
    """Return the bytes of an upload's first file as they are kept."""
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


SIDES = ("STN L 1-3", "STN R 1-3")
MARKS = ((10.0, "stim on 2.5 mA"), (20.0, f"{NAME} feels well"), (50.0, "stim off"))


def edf_file(path: Path) -> bytes:
    """Write the same as EDF+."""
    x = np.random.default_rng(0).normal(0, 2, (2, 15_000))
    signals = [edfio.EdfSignal(v, 250.0, label=n, physical_dimension="uV", physical_range=(-50, 50)) for n, v in zip(SIDES, x, strict=True)]
    notes = [edfio.EdfAnnotation(t, None, text) for t, text in MARKS]
    edfio.Edf(signals, patient=edfio.Patient(name=NAME), data_record_duration=1.0, annotations=notes).write(path)
    return path.read_bytes()


def nwb_file(path: Path) -> bytes:
    """Write the same as NWB."""
    file = nwb.new_file(subject=pynwb.file.Subject(subject_id=NAME), experimenter=[NAME], institution=NAME, notes=NAME)
    region = nwb.add_electrodes(file, list(SIDES), NAME)
    x = np.random.default_rng(0).normal(0, 2e-6, (15_000, 2))
    file.add_acquisition(ElectricalSeries(name="LFP", data=x, electrodes=region, rate=250.0))
    notes = pynwb.misc.AnnotationSeries(name=NAME, data=[text for _, text in MARKS], timestamps=[t for t, _ in MARKS])
    file.add_acquisition(notes)
    nwb.write(path, file)
    return path.read_bytes()


def bids_file(path: Path) -> bytes:
    """Write the same as a zipped BIDS folder with an EDF+."""
    events = [(t, "n/a", "n/a", text) for t, text in MARKS]
    return bids.pack(path, bids.folder({"edf": edf_file(path)}, SIDES, events, 250.0, f"sub-{NAME}_task-rest")).read_bytes()


FILES = {"bids": bids_file, "edf": edf_file, "nwb": nwb_file, "xdf": xdf_file}


@pytest.mark.filterwarnings("ignore::UserWarning")
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
