"""A study brought in at once: folders and a sheet, matched both ways, in a dry run, twice, after a stop, and out again."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app.accounts.permissions import SYSTEM
from app.cli import app
from app.ingest.study_import import StudyReport, import_study
from app.ingest.uploads import service
from app.overview.package import sheet_of
from app.study import repository as study
from app.tables.audit import AuditEvent
from app.tables.sessions import StudySession
from app.tables.uploads import Upload
from ml.formats.studies.sheet import read_sheet, write_sheet
from tests.app.ingest.conftest import DAY, device_zip, steady
from tests.app.ingest.test_clocks import report as percept_report
from tests.app.ingest.test_parts import make_table

HEADER = "participant,visit,date,start,controller,file,minutes,rating,grasp_hz,medication_h,notes"


def clock(minute: float) -> str:
    """Write a moment of the visit's day as a sheet does."""
    return (DAY + timedelta(minutes=minute)).isoformat()


@pytest.fixture
def folder(tmp_path: Path, participant_code: str) -> Path:
    """A folder of participant P1: two recordings of an RC+S, two tables in a zip's place, a report, and what belongs nowhere."""
    root = tmp_path / "study"
    (root / "P1" / "visit 1").mkdir(parents=True)
    (root / "P1" / "visit 1" / "a.zip").write_bytes(device_zip(("random",)))
    (root / "P1" / "visit 1" / "b.zip").write_bytes(device_zip(("cdbs", "random"), minute=60, seed=5))
    (root / "P1" / "visit 1" / "table.csv").write_bytes(steady(1.0))
    (root / "P1" / "visit 1" / "nothing.bin").write_bytes(b"\x00\x01nothing")
    (root / "P1" / "report.json").write_bytes(percept_report(300, seconds=60).replace(b"2026-03-02", b"2026-03-03"))
    (root / "elsewhere").mkdir()
    (root / "elsewhere" / "c.zip").write_bytes(device_zip(("cdbs",), minute=300))
    return root


def sheet(*rows: str) -> bytes:
    """Write a sheet."""
    return "\n".join((HEADER, *rows, "")).encode()


ROWS = (
    f"P1,1,2026-03-02,{clock(0)},random,,,7,2.5,1.5,",
    f"P1,1,2026-03-02,{clock(61)},cdbs,,1,8,,,tired",
    f"P1,1,2026-03-02,{clock(63)},random,,1,6,,,",
    "P1,1,2026-03-02,,no_dbs,table.csv,,,,,",
    f"P1,2,2026-03-03,{clock(24 * 60)},cdbs,,,,,,",
    f"P1,3,2026-04-03,{clock(33 * 24 * 60)},cdbs,,,,,,",
    f"P9,1,2026-03-02,{clock(0)},cdbs,,,,,,",
)


def run(folder: Path, rows: Sequence[str] = ROWS, dry: bool = False) -> StudyReport:
    """Import the folder by a sheet."""
    return import_study([folder], read_sheet(sheet(*rows)), SYSTEM, "test", dry)


def counts(db: Session) -> tuple[int, ...]:
    """Count what an import may add."""
    db.expire_all()
    return tuple(db.scalar(select(func.count()).select_from(t)) or 0 for t in (Upload, StudySession, AuditEvent))


def test_a_dry_run_says_all_and_changes_nothing(folder: Path, db: Session) -> None:
    before = counts(db)
    found = run(folder, dry=True)
    assert counts(db) == before
    assert sorted(line for line, *_ in found.sessions) == [2, 3, 4, 5, 6]
    assert all("would be a session" in said for *_, said in found.sessions)
    assert dict(found.rows)[7].startswith("no session holds 2026-04-04")
    assert "no file of participant P9" in dict(found.rows)[8]
    assert [name for name, _ in found.files] == ["study/elsewhere/c.zip"]
    assert [name for name, _ in found.problems] == ["study/P1/visit 1/nothing.bin"]


def test_the_sheets_sessions_count_with_their_outcomes(folder: Path, db: Session, client: TestClient) -> None:
    found = run(folder)
    assert sorted(line for line, *_ in found.sessions) == [2, 3, 4, 5, 6], found
    assert found.notes == 1
    rows = {s.started_at: s for s in db.scalars(select(StudySession).where(StudySession.status == "confirmed"))}
    first = rows[min(at for at in rows if at is not None)]
    listed = client.get("/api/v1/participants/P1/visits").json()["items"]
    assert [v["number"] for v in listed] == [1, 2, 3]
    assert client.get(f"/api/v1/sessions/{first.id}/qoc").json()["rating"] == 7
    assert first.medication_h == 1.5
    assert None in rows  # the table states no time
    controllers = sorted(client.get(f"/api/v1/sessions/{s.id}").json()["controller"] for s in rows.values())
    assert controllers == ["cdbs", "cdbs", "no_dbs", "random", "random"]


def test_twice_changes_nothing(folder: Path, db: Session) -> None:
    run(folder)
    before = counts(db)
    again = run(folder)
    assert counts(db) == before
    assert all("as it was" in said or "sheet says" in said for *_, said in again.sessions), again.sessions
    assert sorted(line for line, *_ in again.sessions) == [2, 3, 4, 5, 6]


def test_an_import_that_was_cut_short_is_finished_by_the_next(folder: Path, db: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = service.receive
    taken: list[Any] = []

    def stop(*args: Any, **kwargs: Any) -> Any:
        if len(taken) == 2:
            raise KeyboardInterrupt
        taken.append(args)
        return whole(*args, **kwargs)

    monkeypatch.setattr(service, "receive", stop)
    with pytest.raises(KeyboardInterrupt):
        run(folder)
    monkeypatch.setattr(service, "receive", whole)
    assert sorted(line for line, *_ in run(folder).sessions) == [2, 3, 4, 5, 6]
    assert db.scalar(select(func.count()).select_from(StudySession).where(StudySession.status == "confirmed")) == 5


def test_what_the_sheet_says_otherwise_is_told_and_not_changed(folder: Path, db: Session) -> None:
    run(folder)
    other = [ROWS[0].replace(",random,,,7,", ",random,,,5,"), *ROWS[1:]]
    told = {line: said for line, *_, said in run(folder, other).sessions}
    assert "rating is 7, and the sheet says 5: not changed" in told[2]
    wrong = [ROWS[0].replace(",random,", ",cdbs,"), *ROWS[1:]]
    told = {line: said for line, *_, said in run(folder, wrong).sessions}
    assert "not changed: it is of visit 1, random, and the sheet says 1, cdbs" in told[2]


def test_the_sheet_comes_out_and_goes_in_again(folder: Path, db: Session, client: TestClient) -> None:
    run(folder)
    written = write_sheet(sheet_of(db, study.participant_by_code(db, "P1", SYSTEM), SYSTEM))
    again = import_study([folder], read_sheet(written.encode()), SYSTEM, "test")
    assert len(again.sessions) == 5
    assert all("as it was" in said for *_, said in again.sessions), again.sessions
    assert write_sheet(sheet_of(db, study.participant_by_code(db, "P1", SYSTEM), SYSTEM)) == written


def test_the_command_prints_the_report_and_exports_the_sheet(folder: Path, tmp_path: Path, db: Session) -> None:
    path = tmp_path / "sheet.csv"
    path.write_bytes(sheet(ROWS[0]))
    dry = CliRunner().invoke(app, ["import", str(folder / "P1" / "visit 1" / "a.zip"), "--study", str(path), "--dry-run"])
    assert dry.exit_code == 0, dry.output
    assert "Nothing was changed." in dry.output
    done = CliRunner().invoke(app, ["import", str(folder / "P1" / "visit 1" / "a.zip"), "--study", str(path)])
    assert done.exit_code == 0, done.output
    assert "Rows without a session: 0" in done.output
    out = tmp_path / "out.csv"
    assert CliRunner().invoke(app, ["export", "P1", "--sheet", "--to", str(out)]).exit_code == 0
    (row,) = read_sheet(out.read_bytes()).rows
    assert (row.participant, row.controller, row.outcomes) == ("P1", "random", {"rating": 7.0, "grasp_hz": 2.5})


def test_a_table_of_many_sessions_is_matched_by_file_and_session(tmp_path: Path, participant_code: str, db: Session) -> None:
    root = tmp_path / "study"
    root.mkdir()
    (root / "all.csv").write_bytes(make_table({"1": 0.4, "2": 0.8, "3": 1.0}))
    parameters = '{""level"": 0.4}'
    lines = ["participant,visit,date,controller,file,session,rating,lower_bound,design,design_parameters"]
    lines += [f'P1,1,2026-03-02,random,all.csv,{n},{n + 4},0.4,ladder,"{parameters}"' for n in (1, 2, 4)]
    rows = read_sheet("\n".join(lines).encode())
    dry = import_study([root], rows, SYSTEM, "test", True)
    assert [line for line, *_ in dry.sessions] == [2, 3], dry
    done = import_study([root], rows, SYSTEM, "test")
    assert [line for line, *_ in done.sessions] == [2, 3], done
    assert dict(done.rows) == {4: "no session is in all.csv"}
    assert [name for name, _ in done.files] == ["study/all.csv/session 3.csv"]
    confirmed = db.scalars(select(StudySession).where(StudySession.status == "confirmed").order_by(StudySession.id)).all()
    assert [s.qoc.rating for s in confirmed if s.qoc] == [5, 6]
    assert [(s.conditions.lower_bound, s.conditions.design) for s in confirmed if s.conditions] == [(0.4, "ladder")] * 2
    before = counts(db)
    import_study([root], rows, SYSTEM, "test")
    assert counts(db) == before
