"""A whole visit's files in one upload: each is distinguished, none harms another, and hostile ones end as a sentence."""

from __future__ import annotations

import hashlib
import io
import math
import threading
import zipfile
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.ingest.uploads import reading
from app.ingest.uploads.incoming import Incoming, arrange
from app.ingest.uploads.reports import count_equal_lines
from app.platform import files
from app.settings import get_settings
from ml.formats.recording import FileReport
from tests.app.ingest.conftest import device_zip, loose, steady, table
from tests.app.ingest.uploads import readers


def by_name(answer: Any) -> dict[str, Any]:
    return {f["name"]: f for f in answer.json()["files"]}


def zipped(members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return sink.getvalue()


def test_a_visits_files_go_in_together_and_each_is_told(send: Any, recordings: Path) -> None:
    percept = (recordings / "percept" / "percept_session_report.zip").read_bytes()
    tremor = (recordings / "tremor" / "strivepd_wide.csv").read_bytes()
    sweep = (recordings / "rcs" / "stim_sweep.zip").read_bytes()
    answer = send(
        ("stim_sweep.zip", sweep), ("report.zip", percept), ("table.csv", steady(0)), ("tremor.csv", tremor), ("noise.bin", b"\0\1" * 99),
        ("open_fists.csv", b"t_s\n0\n0.5\n1.0\n1.5\n"), *loose(device_zip(), "Session1/DeviceX/"),
    )  # fmt: skip
    assert answer.status_code == 201, answer.text
    told = by_name(answer)
    assert {n: (f["kind"], f["status"]) for n, f in told.items()} == {
        "stim_sweep.zip": ("rcs", "decoded"),
        "report.zip": ("percept", "decoded"),
        "table.csv": ("csv", "decoded"),
        "tremor.csv": ("tremor", "decoded"),
        "noise.bin": ("unreadable", "failed"),
        "open_fists.csv": ("grasp", "decoded"),
        "DeviceX (11 files together)": ("rcs", "decoded"),
    }
    # four streaming runs of the Percept, two RC+S recordings, a table; both sides of a Percept run are one session
    assert len(answer.json()["proposals"]) == 7
    assert len(told["report.zip"]["session_ids"]) == 4
    reported = {r["name"] for r in answer.json()["report"]}
    assert set(told) <= reported


def test_loose_files_of_a_folder_become_one_recording_whatever_their_order(send: Any, client: TestClient) -> None:
    members = loose(device_zip())
    first = send(*members).json()
    assert [f["name"] for f in first["files"]] == ["RC+S files (11 files together)"]
    assert len(first["sessions"]) == 1
    again = send(*[(f"Elsewhere/{n}", c) for n, c in reversed(members)]).json()
    assert (again["sha256"], again["duplicate"]) == (first["sha256"], True)
    assert again["sessions"] == first["sessions"]
    as_zip = send(("same.zip", device_zip())).json()
    assert as_zip["sha256"] != first["sha256"]
    assert as_zip["duplicate"] is True
    assert [s["id"] for s in as_zip["sessions"]] == [s["id"] for s in first["sessions"]]


def test_what_is_kept_of_loose_files_holds_no_serial(send: Any) -> None:
    body = send(*loose(device_zip(), "DeviceSYN000001H/")).json()
    stored = files.path_of(body["files"][0]["stored_sha256"])
    with zipfile.ZipFile(stored) as archive:
        everything = b"".join(n.encode() + archive.read(n) for n in archive.namelist())
    assert b"SYN000001H" not in everything
    assert any("device names" in s for s in body["report"][0]["removed"])


def test_two_folders_dropped_together_are_two_recordings(send: Any) -> None:
    right, left = loose(device_zip(), "S1/DeviceA/"), loose(device_zip(minute=20, seed=9), "S2/DeviceB/")
    answer = send(*right, *left).json()
    assert sorted(f["name"] for f in answer["files"]) == ["DeviceA (11 files together)", "DeviceB (11 files together)"]
    assert len(answer["proposals"]) == 2


def test_loose_files_of_one_recording_that_differ_are_never_mixed(send: Any) -> None:
    first, other = loose(device_zip()), loose(device_zip(seed=9))
    answer = send(*first, *[f for f in other if f not in first])
    assert answer.status_code == 422
    problem = answer.json()
    assert any("nobody can tell which files belong together" in s for r in problem["report"] for s in r["flagged"])
    assert sum(r["problem"] is not None for r in problem["report"]) > 11


def test_litter_of_operating_systems_is_left_aside_and_said(send: Any) -> None:
    answer = send((".DS_Store", b"\0\0\0\1Bud1"), ("t.csv", steady(1)), visit=1)
    assert [f["name"] for f in answer.json()["files"]] == ["t.csv"]
    assert any("operating system" in s for r in answer.json()["report"] if r["name"] == ".DS_Store" for s in r["ignored"])


@pytest.mark.usefixtures("data_folder")
def test_bundles_are_equal_bytes_for_equal_files() -> None:
    parts = [("RawDataTD.json", b"[1]"), ("x/../StimLog.json", b"[2]"), ("note.txt", b"hi")]

    def bundled(order: list[tuple[str, bytes]], folder: str) -> tuple[list[str], bytes]:
        arranged = arrange([Incoming(f"{folder}{n.split('/')[-1]}", io.BytesIO(c)) for n, c in order])
        return [i.name for i in arranged.incoming], arranged.incoming[-1].stream.read()

    names, first = bundled(parts, "")
    assert names == ["note.txt", "RC+S files (2 files together)"]
    assert bundled(parts[::-1], "A/B/")[1] == first
    with zipfile.ZipFile(io.BytesIO(first)) as archive:
        assert {n: archive.read(n) for n in archive.namelist()} == {"RawDataTD.json": b"[1]", "StimLog.json": b"[2]"}


@pytest.mark.parametrize("kind", ["zip", "loose", "percept"])
def test_two_uploads_at_once_of_the_same_files_make_one_recording(
    send: Any, client: TestClient, service_app: Any, participant_code: str, recordings: Path, kind: str, proposals: Any
) -> None:
    parts = {
        "zip": lambda: [("s.zip", device_zip())],
        "loose": lambda: loose(device_zip()),
        "percept": lambda: [("r.zip", (recordings / "percept" / "percept_session_report.zip").read_bytes())],
    }[kind]()
    answers: list[Any] = []

    def go() -> None:
        answers.append(send(*parts, by=TestClient(service_app, headers={"Authorization": client.headers["authorization"]})))

    threads = [threading.Thread(target=go) for _ in range(3)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert [a.status_code for a in answers] == [201] * 3
    assert len({tuple(s["id"] for s in a.json()["sessions"]) for a in answers}) == 1
    assert sorted(a.json()["duplicate"] for a in answers) == [False, True, True]
    assert len(proposals()) == len(answers[0].json()["sessions"]) == (4 if kind == "percept" else 1)


# --- hostile files, each with a good one --------------------------------------------------------------------------------------------------

GOOD = ("good.csv", steady(1))


def bomb() -> bytes:
    """Build a zip of 60 MB of zeros under the name of an RC+S file."""
    return zipped({"DeviceX/RawDataTD.json": b"\0" * 60_000_000})


def encrypted() -> bytes:
    """Build a zip whose only member says that it is encrypted."""
    raw = bytearray(zipped({"DeviceX/RawDataTD.json": b"[]"}))
    raw[6] |= 1
    raw[raw.index(b"PK\x01\x02") + 8] |= 1
    return bytes(raw)


def claims_ten_gigabytes() -> bytes:
    """Build a zip whose directory claims that a member unpacks to 10 GB."""
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w") as archive:
        archive.writestr("DeviceX/RawDataTD.json", b"[]")
        archive.filelist[0].file_size = 10_000_000_000
    return sink.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("bomb.zip", bomb, "times its size"),
        ("secret.zip", encrypted, "encrypted"),
        ("huge.zip", claims_ten_gigabytes, "10000 MB"),
        ("empty.csv", lambda: b"", "empty"),
        ("picture.csv", lambda: b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(400), "no format this service reads"),
        ("formulas.csv", lambda: table([(0, "=cmd|' /C calc'!A0", 1), (2, 1, 1)]), "line 2"),
        ("nested.zip", lambda: zipped({"inner.zip": zipped({"DeviceX/StimLog.json": b"[]"})}), "no RC+S session"),
        ("cut.zip", lambda: device_zip()[:20_000], "zip"),
        ("words.json", lambda: b'{"hello": "world"}', "single JSON file"),
        ("deep.json", lambda: b'{"SessionDate": ' + b"[" * 200_000, ""),
        ("utf16.csv", lambda: "t_s,beta,amplitude_fraction\n0,1,x\n".encode("utf-16"), "line 2"),
    ],
)
def test_a_hostile_file_ends_as_a_sentence_and_the_good_one_beside_it_counts(
    send: Any, client: TestClient, name: str, content: Any, named: str
) -> None:
    answer = send((name, content()), GOOD, visit=1, controller="cdbs")
    assert answer.status_code == 201, answer.text
    told = by_name(answer)
    assert (told[name]["status"], told["good.csv"]["status"]) == ("failed", "decoded")
    problem = next(r["problem"] for r in answer.json()["report"] if r["name"] == name)
    assert named in f"{problem['what']} {problem['where']}"
    assert problem["hint"]
    assert told[name]["quarantined"] == (name != "empty.csv")  # of an empty file there is nothing to keep
    assert len(answer.json()["sessions"]) == 1
    assert client.get("/healthz").status_code == 200


def test_a_wrong_ending_does_not_matter(send: Any) -> None:
    answer = send(("session.csv", device_zip()), ("table.zip", steady(0)), visit=1)
    assert {n: (f["kind"], f["status"]) for n, f in by_name(answer).items()} == {
        "session.csv": ("rcs", "decoded"),
        "table.zip": ("csv", "decoded"),
    }


def test_formulas_in_columns_that_are_not_read_never_reach_the_store(send: Any) -> None:
    content = b't_s,beta,amplitude_fraction,=HYPERLINK("http://x")\n' + b"".join(b"%d,1,1,=1+1\n" % (2 * k) for k in range(5))
    body = send(("t.csv", content), visit=1).json()
    assert b"=" not in files.read(body["files"][0]["stored_sha256"])


def test_one_file_above_the_limit_loses_none_of_the_others(send: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(get_settings(), "upload_limit_mb", 1)
    big = b"t_s,beta,amplitude_fraction\n" + b"0,1,1\n" * 180_000
    answer = send(("big.csv", big), GOOD, visit=1, controller="cdbs")
    assert answer.status_code == 201, answer.text
    assert [f["name"] for f in answer.json()["files"]] == ["good.csv"]
    problem = next(r["problem"] for r in answer.json()["report"] if r["name"] == "big.csv")
    assert "larger than 1 MiB" in problem["what"]
    assert "not kept" in problem["hint"]


def test_a_request_that_claims_ten_gigabytes_is_refused_before_it_is_read(client: TestClient, participant_code: str) -> None:
    headers = {"content-length": "10000000000", "content-type": "multipart/form-data; boundary=x"}
    answer = client.post("/api/v1/uploads", headers=headers, content=b"")
    assert answer.status_code == 413
    assert answer.headers["content-type"] == "application/problem+json"


def test_a_fault_of_our_own_decoder_keeps_the_bytes_and_the_other_files(
    send: Any, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    real = reading.DECODE
    monkeypatch.setattr(reading, "DECODE", f"{readers.__name__}:fault_of_rcs")
    answer = send(("s.zip", device_zip()), GOOD, visit=1, controller="cdbs")
    told = by_name(answer)
    assert (told["s.zip"]["status"], told["good.csv"]["status"]) == ("failed", "decoded")
    assert files.path_of(told["s.zip"]["stored_sha256"]).exists()
    assert "fault_of_rcs" in capfd.readouterr().err, "the log names the place in the code"
    monkeypatch.setattr(reading, "DECODE", real)
    assert by_name(send(("s.zip", device_zip()), visit=1))["s.zip"]["status"] == "decoded"


def test_a_fault_while_identity_is_taken_out_keeps_the_file_encrypted(send: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "CLEAN", f"{readers.__name__}:fault_of_cleaning")
    told = by_name(send(("s.zip", device_zip()), GOOD, visit=1, controller="cdbs"))
    assert (told["s.zip"]["status"], told["s.zip"]["quarantined"], told["good.csv"]["status"]) == ("failed", True, "decoded")
    assert not any(b"SYN000001H" in p.read_bytes() for p in get_settings().files_dir.rglob("*") if p.is_file())


def test_the_participants_measure_of_beta_and_the_stated_unit_of_lfp_are_used(send: Any, client: TestClient) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"beta_measure": "power"}})
    session = send(("s.zip", device_zip()), visit=1, controller="random").json()["sessions"][0]["id"]
    assert client.get(f"/api/v1/sessions/{session}/trace").json()["beta_unit"] == "uV2"
    lfp = b"t_s,lfp\n" + b"".join(b"%.3f,%.3f\n" % (k / 250, math.sin(k)) for k in range(2500))
    refused = send(("lfp.csv", lfp), visit=1, controller="random")
    assert refused.status_code == 422
    assert send(("lfp.csv", lfp), visit=1, controller="random", lfp_unit="uV").status_code == 201


def test_the_report_names_hashes_and_the_redactor(send: Any) -> None:
    content = device_zip()
    told = by_name(send(("s.zip", content)))["s.zip"]
    assert told["sha256"] == hashlib.sha256(content).hexdigest()
    assert told["stored_sha256"] != told["sha256"]
    assert told["redactor_version"] >= 2
    assert hashlib.sha256(files.read(told["stored_sha256"])).hexdigest() == told["stored_sha256"]


EMPTY_ARCHIVE = b"PK\x05\x06" + bytes(18)


@pytest.mark.parametrize(
    "content",
    [b"", b" \r\n \n", b"\xef\xbb\xbf", b"[]", b"[{}]", b"{ }", bytes(300), EMPTY_ARCHIVE, zipped({"DeviceX/RawDataTD.json": b""})],
    ids=["no byte", "blanks", "a mark", "a list", "a list of nothing", "an object", "zeros", "an archive", "an archive of empty files"],
)
def test_an_empty_file_says_that_it_is_empty(send: Any, content: bytes) -> None:
    problem = send(("session.json", content), visit=1).json()["report"][0]["problem"]
    assert "empty" in problem["what"]
    assert problem["hint"]


def test_twenty_equal_lines_are_one_line_with_their_count(send: Any) -> None:
    session = loose(device_zip())
    nested = {f"inner {n}.zip": b"PK" for n in range(20)}
    archive = zipped(dict(session) | nested)
    litter = [(f"folder/._{n}", b"x") for n in range(20)]
    answer = send(("s.zip", archive), *litter, visit=1, controller="random").json()
    ignored = next(r for r in answer["report"] if r["name"] == "s.zip")["ignored"]
    told = "an archive inside the archive; unpack it and upload it by itself"
    (line,) = [text for text in ignored if told in text]
    first = len(session) + 1
    assert line == f"20 members (.zip, number {', '.join(str(first + n) for n in range(5))}, …): {told}"
    (aside,) = [r for r in answer["report"] if "left by the operating system" in repr(r["ignored"])]
    assert aside["name"] == "._0 and 19 more"
    report = FileReport("x", flagged=["the same", *["again"] * 20, "other"])
    count_equal_lines(report)
    assert report.flagged == ["the same", "again (20×)", "other"]


def test_what_was_removed_is_named_by_its_kind(send: Any) -> None:
    head = "t_s,beta,amplitude_fraction,patientName,Date of birth,clinician note,serial no,battery rate,zzz"
    content = "\n".join([head, *(f"{2 * k},1,1,a,b,c,d,e,f" for k in range(5))]).encode()
    (line,) = send(("t.csv", content), visit=1).json()["report"][0]["removed"]
    kinds = "1 called like a date, 1 called like a note, 2 called like an identifier, 1 called like a measurement, 1 of no known kind"
    assert line == f"6 other columns: {kinds}"
