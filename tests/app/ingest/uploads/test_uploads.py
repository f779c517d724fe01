"""Uploads over REST: alignment, idempotence, errors that lose nothing, identity that never arrives."""

from __future__ import annotations

import io
import threading
import zipfile
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fastapi.testclient import TestClient

from app.ingest import encryption
from app.platform import files
from app.settings import get_settings

TABLE = b"""t_s,beta,amplitude_fraction
-2,0.8,1
0,0.9,1
2,1.5,0.5
4,1.2,0.6
6,0.7,1.2
"""


def upload(client: TestClient, content: bytes, name: str = "session.csv", **fields: Any) -> Any:
    """Post one file for P1, visit 1, a random session by default."""
    data = {"participant": "P1", "visit": "1", "controller": "random"} | {k: str(v) for k, v in fields.items()}
    return client.post("/api/v1/uploads", data=data, files={"file": (name, content)})


def test_a_table_becomes_a_confirmed_session_on_the_papers_grid(client: TestClient, participant_code: str) -> None:
    answer = upload(client, TABLE)
    assert answer.status_code == 201
    body = answer.json()
    assert set(body) >= {"id", "sha256", "duplicate", "sessions", "report"}
    assert body["duplicate"] is False
    (session,) = body["sessions"]
    assert (session["controller"], session["visit"], session["status"], session["duration_s"]) == ("random", 1, "confirmed", 6)
    trace = client.get(f"/api/v1/sessions/{session['id']}/trace").json()
    rows = {
        t: (b, m, a) for t, b, m, a in zip(trace["t_s"], trace["beta"], trace["amplitude_ma"], trace["amplitude_fraction"], strict=True)
    }
    assert trace["t_s"] == [2.0 * k for k in range(-9, 4)]
    assert rows[-4] == (None, None, None)
    assert rows[0][0] == pytest.approx(0.9)
    assert rows[2] == pytest.approx((1.5, 1.5, 0.5))
    assert rows[6] == pytest.approx((0.7, 3.6, 1.2))


def test_a_fraction_above_one_is_stored_and_flagged_not_clipped(client: TestClient, participant_code: str) -> None:
    body = upload(client, TABLE).json()
    trace = client.get(f"/api/v1/sessions/{body['sessions'][0]['id']}/trace").json()
    assert trace["steps_above_cdbs"] == 1
    assert max(a for a in trace["amplitude_fraction"] if a is not None) == pytest.approx(1.2)
    assert any("above" in sentence or "exceed" in sentence for report in body["report"] for sentence in report["flagged"])


def test_parquet_gives_the_same_trace_as_csv(client: TestClient, participant_code: str) -> None:
    sink = io.BytesIO()
    columns = {"t_s": [-2.0, 0, 2, 4, 6], "beta": [0.8, 0.9, 1.5, 1.2, 0.7], "amplitude_fraction": [1, 1, 0.5, 0.6, 1.2]}
    pq.write_table(pa.table(columns), sink)
    first = upload(client, TABLE).json()
    other = client.post("/api/v1/participants", json={"code": "P2", "settings": {"cdbs_amplitude_ma": 3.0}})
    assert other.status_code == 201
    client.post("/api/v1/participants/P2/visits", json={"number": 1})
    second = upload(client, sink.getvalue(), "session.parquet", participant="P2").json()
    traces = [client.get(f"/api/v1/sessions/{b['sessions'][0]['id']}/trace").json() for b in (first, second)]
    assert traces[0]["beta"] == traces[1]["beta"]
    assert traces[0]["amplitude_fraction"] == traces[1]["amplitude_fraction"]


def test_the_same_bytes_again_change_nothing_and_say_so(client: TestClient, participant_code: str) -> None:
    first = upload(client, TABLE).json()
    again = upload(client, TABLE, name="copy.csv", controller="cdbs")
    assert again.status_code == 201
    body = again.json()
    assert body["duplicate"] is True
    assert [s["id"] for s in body["sessions"]] == [s["id"] for s in first["sessions"]]
    assert body["sessions"][0]["controller"] == "random"
    assert "was not changed" in body["report"][0]["flagged"][0]
    visit = client.get("/api/v1/participants/P1/visits").json()["items"][0]["id"]
    assert client.get(f"/api/v1/visits/{visit}/sessions").json()["total"] == 1


def test_the_same_recording_in_another_file_is_the_same_session(client: TestClient, participant_code: str) -> None:
    first = upload(client, TABLE).json()
    other = upload(client, TABLE.replace(b",", b";"), name="semicolons.csv").json()
    assert other["sha256"] != first["sha256"]
    assert other["duplicate"] is True
    assert other["sessions"][0]["id"] == first["sessions"][0]["id"]


def test_two_uploads_at_once_of_one_file_make_one_session(
    service_app: Any, make_token: Any, client: TestClient, participant_code: str
) -> None:
    headers = dict(client.headers)
    answers: list[Any] = []

    def send() -> None:
        answers.append(upload(TestClient(service_app, headers={"Authorization": headers["authorization"]}), TABLE))

    threads = [threading.Thread(target=send) for _ in range(4)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert {a.status_code for a in answers} == {201}
    assert len({a.json()["sessions"][0]["id"] for a in answers}) == 1
    assert sorted(a.json()["duplicate"] for a in answers) == [False, True, True, True]


@pytest.mark.parametrize(
    ("content", "name", "named"),
    [
        (b"time,level\n1,2\n", "columns.csv", "beta"),
        (b"t_s,beta,amplitude_fraction\n2,abc,1\n", "text.csv", "line 2"),
        (b"PK\x03\x04 not a zip", "broken.zip", "zip"),
        (b"\x00\x01\x02\x03" * 100, "noise.bin", "format"),
    ],
)
def test_a_file_of_no_use_is_kept_and_named(client: TestClient, participant_code: str, content: bytes, name: str, named: str) -> None:
    answer = upload(client, content, name)
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert problem["file"] == name
    assert name in problem["detail"]
    assert named in (problem["detail"] + problem["where"]).lower()
    assert problem["hint"]
    kept = client.get(f"/api/v1/uploads/{problem['upload_id']}").json()["files"][0]
    assert kept["status"] == "failed"
    assert files.path_of(kept["stored_sha256"]).exists()


def test_of_an_empty_file_nothing_is_kept_and_the_answer_says_so(client: TestClient, participant_code: str) -> None:
    answer = upload(client, b"", "empty.csv")
    assert answer.status_code == 422
    assert "empty.csv: the file is empty (0 bytes). Nothing of it was kept." in answer.json()["detail"]
    again = upload(client, b"", "empty.csv").json()
    assert client.get(f"/api/v1/uploads/{again['upload_id']}").json()["files"][0]["stored_sha256"] is None


def test_what_cannot_be_parsed_is_kept_encrypted(client: TestClient, participant_code: str) -> None:
    secret = b"\x00\x01 Jane Example, born 1950 " * 10
    problem = upload(client, secret, "noise.bin").json()
    kept = client.get(f"/api/v1/uploads/{problem['upload_id']}").json()["files"][0]["stored_sha256"]
    assert b"Jane" not in files.read(kept)
    assert b"".join(encryption.decrypt(files.path_of(kept))) == secret


def test_a_bad_file_loses_nothing_else_in_the_upload(client: TestClient, participant_code: str) -> None:
    data = {"participant": "P1", "visit": "1", "controller": "random"}
    answer = client.post("/api/v1/uploads", data=data, files=[("file", ("bad.csv", b"x,y\n1,2\n")), ("file", ("good.csv", TABLE))])
    assert answer.status_code == 201
    body = answer.json()
    assert [f["status"] for f in body["files"]] == ["failed", "decoded"]
    assert len(body["sessions"]) == 1
    assert [r["name"] for r in body["report"] if r["problem"]] == ["bad.csv"]


@pytest.mark.parametrize(
    ("fields", "status", "named"),
    [
        ({"participant": "P7"}, 404, "P7"),
        ({"visit": 9}, 422, "visit 9"),
        ({"visit": "one"}, 422, "visit"),
        ({"controller": "warp"}, 422, "controller"),
        ({"policy": "ghost"}, 422, "ghost"),
    ],
)
def test_what_is_stated_must_exist(client: TestClient, participant_code: str, fields: dict[str, Any], status: int, named: str) -> None:
    answer = upload(client, TABLE, **fields)
    assert answer.status_code == status
    assert named in answer.text


def test_more_bytes_than_allowed_are_refused(client: TestClient, participant_code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(get_settings(), "upload_limit_mb", 1)
    answer = upload(client, b"t_s,beta,amplitude_fraction\n" + b"0,1,1\n" * 600_000)
    assert answer.status_code == 413
    assert "1 MiB" in answer.json()["detail"]


def test_a_viewer_may_not_upload(client: TestClient, client_as: Any, participant_code: str) -> None:
    assert upload(client_as("viewer"), TABLE).status_code == 403


def test_the_stimulation_sweep_becomes_a_session_with_its_steps(client: TestClient, participant_code: str, recordings: Path) -> None:
    content = (recordings / "rcs" / "stim_sweep.zip").read_bytes()
    answer = upload(client, content, "stim_sweep.zip", controller="other")
    assert answer.status_code == 201
    session = answer.json()["sessions"][0]
    trace = client.get(f"/api/v1/sessions/{session['id']}/trace").json()
    assert (trace["beta_unit"], trace["beta_source"]) == ("device units", "device_power")
    assert session["duration_s"] == pytest.approx(444, abs=2)
    amplitudes = [a for a in trace["amplitude_ma"] if a is not None]
    assert (min(amplitudes), max(amplitudes)) == (0, pytest.approx(2.4))
    by_amplitude = {
        level: [
            b for b, a in zip(trace["beta"], trace["amplitude_ma"], strict=True) if b is not None and a == pytest.approx(level, abs=1e-4)
        ]
        for level in (0, 1.1, 2.4)
    }
    means = {level: sum(b) / len(b) for level, b in by_amplitude.items()}
    assert means[0] > 2 * means[1.1] > means[2.4]


def test_no_identity_of_a_device_file_is_stored_anywhere(client: TestClient, participant_code: str, recordings: Path) -> None:
    archive = recordings / "rcs" / "stim_sweep.zip"
    with zipfile.ZipFile(archive) as zipped:
        serials = {part for name in zipped.namelist() for part in name.split("/") if part.startswith("Device") and "." not in part}
    serials = {s.removeprefix("Device") for s in serials} - {""}
    assert serials
    assert upload(client, archive.read_bytes(), "npc.zip", controller="other").status_code == 201
    archives = [path for path in get_settings().files_dir.rglob("*") if path.is_file() and zipfile.is_zipfile(path)]
    assert archives
    for path in archives:
        with zipfile.ZipFile(path) as zipped:
            stored = b"".join(zipped.read(n) + n.encode() for n in zipped.namelist())
        assert not any(s.encode() in stored for s in serials)


def test_a_stated_start_inside_a_recording_leaves_what_came_before_as_the_lead(
    client: TestClient, participant_code: str, recordings: Path
) -> None:
    content = (recordings / "rcs" / "stim_sweep.zip").read_bytes()
    body = upload(client, content, "stim_sweep.zip", controller="other", started_at="2019-08-15T19:33:45.6Z").json()
    session = body["sessions"][0]
    assert session["duration_s"] == pytest.approx(443.5 - 32, abs=1)
    trace = client.get(f"/api/v1/sessions/{session['id']}/trace").json()
    lead = [b for t, b in zip(trace["t_s"], trace["beta"], strict=True) if t <= 0]
    assert len(lead) == 10
    assert None not in lead


def test_the_participants_unit_and_source_are_taken_and_said(client: TestClient, participant_code: str) -> None:
    body = upload(client, TABLE).json()
    trace = client.get(f"/api/v1/sessions/{body['sessions'][0]['id']}/trace").json()
    assert (trace["beta_unit"], trace["beta_source"]) == ("uV", "table")
    said = "unit 'uV' as the participant's settings say, source 'table' as the participant's settings say"
    assert any(said in s for s in body["report"][0]["understood"])


def test_a_stated_unit_and_source_win(client: TestClient, participant_code: str) -> None:
    body = upload(client, TABLE, beta_unit="mV", beta_source="time_domain").json()
    trace = client.get(f"/api/v1/sessions/{body['sessions'][0]['id']}/trace").json()
    assert (trace["beta_unit"], trace["beta_source"]) == ("mV", "time_domain")
    said = "unit 'mV' as stated with the upload, source 'time_domain' as stated with the upload"
    assert any(said in s for s in body["report"][0]["understood"])


def test_the_headers_unit_wins_over_the_stated_one_and_a_contradiction_is_flagged(client: TestClient, participant_code: str) -> None:
    body = upload(client, TABLE.replace(b"beta", b"beta [mV]"), beta_unit="uV").json()
    report = body["report"][0]
    assert any("unit 'mV' as the file's header says, source 'table' as the participant's settings say" in s for s in report["understood"])
    assert any("beta is in 'mV' as the file's header says, the upload says 'uV'" in s for s in report["flagged"])


def test_other_columns_of_a_table_are_neither_stored_nor_named(client: TestClient, participant_code: str) -> None:
    lines = TABLE.decode().splitlines()
    content = "\n".join([lines[0] + ",Jane Doe MRN 4711", *(f"{line},1950-03-01" for line in lines[1:])]).encode()
    answer = upload(client, content)
    assert answer.status_code == 201
    assert "Jane" not in answer.text
    assert answer.json()["report"][0]["removed"] == ["1 other column: 1 called like an identifier"]
    kept = files.read(answer.json()["files"][0]["stored_sha256"])
    assert kept.startswith(b"t_s,beta,amplitude_fraction\n-2.0,0.8,1.0\n")
    assert not any(word in kept for word in (b"Jane", b"4711", b"1950"))


def test_a_table_of_no_use_is_quoted_to_its_sender_alone(client: TestClient, participant_code: str) -> None:
    problem = upload(client, b"t_s,beta,Jane Doe\n2,1,1\n", "session.csv").json()
    assert "'Jane Doe'" in problem["detail"]
    later = client.get(f"/api/v1/uploads/{problem['upload_id']}")
    assert "missing column amplitude_fraction" in later.text
    assert "Jane" not in later.text
    kept = later.json()["files"][0]
    assert kept["kind"] == "unreadable"
    assert b"Jane" not in files.read(kept["stored_sha256"])


def test_a_threshold_in_another_unit_is_never_held_against_a_trace(client: TestClient, participant_code: str, recordings: Path) -> None:
    content = (recordings / "rcs" / "stim_sweep.zip").read_bytes()
    session = upload(client, content, "stim_sweep.zip", controller="other").json()["sessions"][0]["id"]
    assert client.get(f"/api/v1/sessions/{session}/trace").json()["xi_beta"] is None
    page = client.get(f"/sessions/{session}").text
    assert "They are not comparable" in page
    assert "of valid steps" not in page
    table = upload(client, TABLE).json()["sessions"][0]["id"]
    assert client.get(f"/api/v1/sessions/{table}/trace").json()["xi_beta"] == 1.0


def test_the_session_page_shows_the_devices_steps_and_the_notes_that_disagree(
    client: TestClient, participant_code: str, recordings: Path
) -> None:
    content = (recordings / "rcs" / "stim_sweep.zip").read_bytes()
    session = upload(client, content, "stim_sweep.zip", controller="other").json()["sessions"][0]["id"]
    page = client.get(f"/sessions/{session}").text
    levels = ("0.00", "0.30", "0.80", "0.60", "0.90", "1.10", "1.30", "1.60", "1.90", "2.20", "2.40")
    assert f"n = {len(levels)}" in page
    assert all(f'<td class="num">{level}</td>' in page for level in levels)
    assert "n = 4 that disagree" in page


def test_what_was_delivered_does_not_change_when_the_cdbs_amplitude_does(client: TestClient, participant_code: str) -> None:
    session = upload(client, TABLE).json()["sessions"][0]["id"]
    before = client.get(f"/api/v1/sessions/{session}/trace").json()
    client.put(f"/api/v1/participants/{participant_code}/settings", json={"settings": {"cdbs_amplitude_ma": 2.0}})
    after = client.get(f"/api/v1/sessions/{session}/trace").json()
    assert before["amplitude_ma"] == after["amplitude_ma"]
    assert after["amplitude_fraction"][-1] == pytest.approx(1.8)


@pytest.mark.parametrize("start", ["0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-14:00", "1969-01-01T00:00:00Z"])
def test_a_start_outside_the_calendar_is_refused_and_nothing_is_stored(client: TestClient, participant_code: str, start: str) -> None:
    assert upload(client, TABLE, started_at=start).status_code == 422
    visit = client.get("/api/v1/participants/P1/visits").json()["items"][0]["id"]
    assert client.get(f"/api/v1/visits/{visit}/sessions").json()["total"] == 0


def test_a_controller_that_contradicts_its_amplitudes_is_flagged(client: TestClient, participant_code: str) -> None:
    flagged = upload(client, TABLE, controller="no_dbs").json()["report"][0]["flagged"]
    assert any("Said to be without DBS, but its mean amplitude is 77 %" in s for s in flagged)


def test_the_upload_of_a_file_that_came_before_can_be_read_again(client: TestClient, participant_code: str) -> None:
    first = upload(client, TABLE).json()
    again = upload(client, TABLE).json()
    assert again["id"] != first["id"]
    read = client.get(f"/api/v1/uploads/{again['id']}")
    assert read.status_code == 200
    assert read.json()["duplicate"] is True
    assert read.json()["sessions"] == first["sessions"]


def test_a_recording_without_data_is_kept_and_makes_no_session(client: TestClient, participant_code: str, recordings: Path) -> None:
    answer = upload(client, (recordings / "rcs" / "empty_streams.zip").read_bytes(), "empty_streams.zip", controller="other")
    assert answer.status_code == 201
    assert answer.json()["sessions"] == []
    assert any("no session was made" in s for s in answer.json()["report"][0]["flagged"])


@pytest.mark.parametrize("fields", [{"beta_unit": "a\0b"}, {"participant": "P\0"}, {"policy": "\0"}])
def test_a_zero_character_is_refused_in_words(client: TestClient, participant_code: str, fields: dict[str, str]) -> None:
    assert upload(client, TABLE, **fields).status_code == 422
