"""A file that holds several: a zip of tables and reports, and a table with a column of sessions. Each part is a file of its own."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.study.traces import step_table
from app.tables.sessions import StudySession
from app.tables.uploads import UploadFile
from tests.app.ingest.conftest import Send, device_zip, steady
from tests.app.ingest.test_clocks import report as percept_report

LEVELS = {"a": 0.4, "b": 0.8, "c": 1.0}


def make_table(sessions: dict[str, float] = LEVELS, steps: int = 20, run_on: bool = False) -> bytes:
    """Write a table of several sessions, each of one amplitude."""
    lines = ["session;t_s;beta;amplitude_fraction"]
    for number, (name, level) in enumerate(sessions.items()):
        begin = number * 2 * steps if run_on else 0
        lines += [f"{name};{begin + 2 * k};{10 + number};{level}" for k in range(1, steps + 1)]
    return "\n".join(lines).encode()


def make_zip(**files: bytes) -> bytes:
    """Write a zip of files by their stems; the ending follows two underscores."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in files.items():
            archive.writestr(f"visit 1/{name.replace('__', '.')}", content)
    return out.getvalue()


def list_levels(db: Session) -> list[float]:
    """List the amplitudes of the participant's sessions, each of which has one throughout."""
    found = []
    for session in db.scalars(select(StudySession).order_by(StudySession.id)):
        table = step_table(db, session, session.visit.participant.current_settings)
        stated = table.amplitude_ma[np.isfinite(table.amplitude_ma)]
        (level,) = set(stated.round(3).tolist())
        assert len(stated) == 20
        found.append(level)
    return found


def test_a_column_of_sessions_makes_a_session_each(send: Send, db: Session) -> None:
    answer = send(("all.csv", make_table()), visit=1, controller="random")
    assert answer.status_code == 201, answer.text
    assert len(answer.json()["sessions"]) == 3
    assert [f["name"] for f in answer.json()["files"]] == ["session a.csv", "session b.csv", "session c.csv"]
    assert list_levels(db) == [1.2, 2.4, 3.0]
    before = db.scalar(select(func.count()).select_from(UploadFile))
    again = send(("renamed.csv", make_table()), visit=1, controller="random").json()
    assert again["duplicate"]
    assert db.scalar(select(func.count()).select_from(UploadFile)) == before


def test_a_row_is_named_by_its_line_in_the_whole_table(send: Send) -> None:
    wrong = make_table().decode().splitlines()
    wrong[30] = wrong[30].replace(";0.8", ";much")
    answer = send(("all.csv", "\n".join(wrong).encode()), visit=1, controller="random").json()
    assert len(answer["sessions"]) == 2
    (problem,) = [r["problem"] for r in answer["report"] if r["problem"]]
    assert problem["where"].startswith("line 31, column amplitude_fraction")


def test_a_parquet_of_several_sessions(send: Send, db: Session) -> None:
    rows = [(n, 2.0 * k, 10.0 + n, level) for n, level in enumerate(LEVELS.values(), start=1) for k in range(1, 21)]
    columns = dict(zip(("session", "t_s", "beta", "amplitude_fraction"), map(list, zip(*rows, strict=True)), strict=True))
    out = io.BytesIO()
    pq.write_table(pa.table(columns), out)
    answer = send(("all.parquet", out.getvalue()), visit=1, controller="random")
    assert len(answer.json()["sessions"]) == 3, answer.text
    assert list_levels(db) == [1.2, 2.4, 3.0]


def test_one_session_in_the_column_is_one_table(send: Send) -> None:
    answer = send(("one.csv", make_table({"a": 0.4})), visit=1, controller="random").json()
    assert [f["name"] for f in answer["files"]] == ["one.csv"]


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (make_table(run_on=True), "the times run on from one session to the next"),
        (make_table().replace(b"\na;4;", b"\n;4;"), "the row names no session"),
    ],
)
def test_sessions_that_cannot_be_told_apart_are_refused(send: Send, content: bytes, what: str) -> None:
    answer = send(("all.csv", content), visit=1, controller="random")
    assert answer.status_code == 422
    assert what in answer.text


def test_a_zip_of_tables_and_a_report(send: Send, client: TestClient) -> None:
    content = make_zip(a__csv=steady(0.4), b__csv=steady(0.8, beta=2.0), report__json=percept_report(300, seconds=60), readme__txt=b"hello")
    answer = send(("visit.zip", content), visit=1, controller="random")
    assert answer.status_code == 201, answer.text
    assert [f["name"] for f in answer.json()["files"]] == ["a.csv", "b.csv", "report.json"]
    assert len(answer.json()["sessions"]) == 3
    report = next(r for r in answer.json()["report"] if r["name"] == "visit.zip")
    assert "3 recordings or tables" in report["understood"][0]
    assert report["ignored"] == ["1 file of the archive: neither a table nor a recording"]


def test_a_zip_of_tables_with_sessions_in_one(send: Send) -> None:
    answer = send(("visit.zip", make_zip(a__csv=steady(0.4), all__csv=make_table())), visit=1, controller="random").json()
    assert len(answer["sessions"]) == 4


def test_a_device_folder_stays_one_recording(send: Send) -> None:
    answer = send(("device.zip", device_zip()), visit=1, controller="random").json()
    assert [f["kind"] for f in answer["files"]] == ["rcs"]
