"""The console command as a newcomer's shell sees it: exit codes, --json, --help with an example."""

from __future__ import annotations

import csv
import io
import json
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import psycopg
import pytest
import structlog
from typer.testing import CliRunner

from app.accounts.permissions import SYSTEM
from app.cli import app, main
from app.overview.package import export_participant
from app.platform.database import owner_url, transaction
from app.study.repository import participant_by_code
from app.tables.participants import Hemisphere
from app.tables.sessions import StudySession
from app.tables.visits import CdbsAmplitude
from tests.app.ingest.uploads.test_uploads_of_formats import FILES

COMMANDS = (
    "serve", "worker", "demo", "migrate", "user add", "token create", "import", "pipeline", "rank", "export", "control",
    "ingest redecode", "ingest resume", "study simulate", "where", "take-back-jobs", "backup-key", "backup", "restore", "doctor",
    "next-generation", "audit verify", "audit seal", "study add", "study site", "user role",
)  # fmt: skip
TABLE = "t_s,beta,amplitude_fraction\n0,1,1\n2,1,0.5\n4,2,0.5\n"


Betaloop = Callable[..., "Ended"]


class Ended(NamedTuple):
    """End of a command: its exit code and output."""

    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def betaloop(monkeypatch: pytest.MonkeyPatch) -> Iterator[Betaloop]:
    """Function that runs the command in this process, from its arguments to its exit code: to start an interpreter for each takes
    seconds.
    """
    logs, signals = structlog.get_config(), {n: signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGHUP)}
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments: str, stdin: str = "") -> Ended:
        monkeypatch.setattr(sys, "argv", ["betaloop", *arguments])
        monkeypatch.setattr(sys, "stdin", io.StringIO(stdin))
        with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err, pytest.raises(SystemExit) as ended:
            main()
        return Ended(int(ended.value.code or 0), out.getvalue(), err.getvalue())

    yield run
    structlog.configure(**logs)
    for number, handler in signals.items():
        signal.signal(number, handler)


@pytest.fixture
def study(fresh_database: str, participant_code: str) -> str:
    return participant_code


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command: str) -> None:
    result = CliRunner().invoke(app, [*command.split(), "--help"])
    assert result.exit_code == 0
    assert "Example: betaloop" in result.output


def test_a_user_and_a_token_are_made_and_the_token_is_printed_once(fresh_database: str, betaloop: Betaloop) -> None:
    added = betaloop(
        "user", "add", "ada@clinic.example", "--role", "clinician", "--password-file", "-", "--json", stdin="a long password\n"
    )
    assert added.returncode == 0, added.stderr
    assert json.loads(added.stdout)["role"] == "clinician"
    token = betaloop("token", "create", "ada@clinic.example", "--name", "tablet")
    assert token.returncode == 0
    assert token.stdout.strip().startswith("blp_")
    again = betaloop("token", "create", "ada@clinic.example", "--name", "tablet")
    assert again.returncode == 1
    assert "already has a token" in again.stderr
    assert "Traceback" not in again.stderr


def test_import_and_export_carry_a_session_round(study: str, tmp_path: Path, betaloop: Betaloop) -> None:
    table = tmp_path / "session.csv"
    table.write_text(TABLE)
    done = betaloop("import", str(table), "--participant", study, "--visit", "1", "--controller", "random", "--json")
    assert done.returncode == 0, done.stderr
    session = json.loads(done.stdout)["sessions"][0]
    assert (session["controller"], session["duration_s"]) == ("random", 4)
    out = tmp_path / "record.zip"
    exported = betaloop("export", study, "--to", str(out), "--json")
    assert exported.returncode == 0, exported.stderr
    with zipfile.ZipFile(out) as archive:
        steps = archive.read(f"{study}/steps.csv").decode().splitlines()
        sessions = archive.read(f"{study}/sessions.csv").decode()
    assert steps[-1].split(",")[1:] == ["4.0", "2.0", "1.5", "0.5"]
    assert "random" in sessions


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("kind", sorted(FILES))
def test_import_reads_a_lab_s_recording(kind: str, study: str, tmp_path: Path, betaloop: Betaloop) -> None:
    FILES[kind](tmp_path / "file")
    done = betaloop("import", str(tmp_path / "file"), "--participant", study, "--visit", "1", "--controller", "other", "--json")
    assert done.returncode == 0, done.stderr
    (session,) = json.loads(done.stdout)["sessions"]
    assert (session["controller"], session["duration_s"]) == ("other", 60)


@pytest.mark.parametrize(
    ("arguments", "code", "named"),
    [
        (["import", "missing.csv", "--participant", "P1", "--visit", "1", "--controller", "cdbs"], 2, "missing.csv"),
        (["rank", "P404"], 1, "P404"),
        (["export", "P404"], 1, "P404"),
        (["pipeline", "P404"], 1, "P404"),
        (["user", "add", "x@y.example", "--role", "king"], 2, "king"),
        (["warp"], 2, "warp"),
    ],
)
def test_what_cannot_be_done_is_said_in_a_line(
    fresh_database: str, arguments: list[str], code: int, named: str, betaloop: Betaloop
) -> None:
    result = betaloop(*arguments)
    assert result.returncode == code
    assert named in result.stderr
    assert "Traceback" not in result.stderr


def test_a_process_of_its_own_ends_like_that_too(fresh_database: str) -> None:
    result = subprocess.run([sys.executable, "-m", "app.cli", "export", "P404"], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout, len(result.stderr.splitlines())) == (1, "", 1)
    assert "P404" in result.stderr


def test_a_file_of_no_use_is_exit_code_1_with_the_hint(study: str, tmp_path: Path, betaloop: Betaloop) -> None:
    table = tmp_path / "wrong.csv"
    table.write_text("a,b\n1,2\n")
    result = betaloop("import", str(table), "--participant", study, "--visit", "1", "--controller", "cdbs")
    assert result.returncode == 1
    assert "wrong.csv" in result.stderr
    assert "amplitude_fraction" in result.stderr


def test_a_database_without_tables_is_said_in_a_line(fresh_database: str, betaloop: Betaloop) -> None:
    with psycopg.connect(owner_url().replace("+psycopg", ""), autocommit=True) as connection:
        connection.execute("drop owned by current_user cascade")
    done = betaloop("user", "add", "ada@clinic.example", "--role", "admin", "--password-file", "-", stdin="correct horse battery")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.strip() == "betaloop: the database does not have the tables of this version: run `betaloop migrate` first"


def test_migrating_twice_is_harmless(fresh_database: str, betaloop: Betaloop) -> None:
    for _ in range(2):
        result = betaloop("migrate")
        assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "named"),
    [
        (["user", "add", "x@y.example", "--role", "viewer", "--password-file", "no-such-file"], 2, "no-such-file"),
        (["export", "P1", "--to", "no-such-folder/x.zip"], 2, "no-such-folder"),
        (["export", "P1", "--to", "."], 2, "is a folder"),
    ],
)
def test_a_path_of_no_use_is_one_line_and_exit_code_2(study: str, arguments: list[str], code: int, named: str, betaloop: Betaloop) -> None:
    result = betaloop(*arguments)
    assert result.returncode == code
    assert named in result.stderr
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.slow
def test_a_session_that_cannot_be_read_does_not_stop_the_export(study: str, tmp_path: Path, betaloop: Betaloop) -> None:
    table = tmp_path / "session.csv"
    table.write_text(TABLE)
    done = betaloop("import", str(table), "--participant", study, "--visit", "1", "--controller", "random", "--json")
    assert done.returncode == 0, done.stderr
    broken = json.loads(done.stdout)["sessions"][0]["id"]
    table.write_text(TABLE.replace("2,1,0.5", "2,1,0.75"))
    fine = json.loads(betaloop("import", str(table), "--participant", study, "--visit", "1", "--controller", "random", "--json").stdout)
    with transaction("test") as db:
        db.get_one(StudySession, broken).visit.cdbs_amplitudes = [
            CdbsAmplitude(hemisphere=side, program=0, amplitude_ma=3.0) for side in Hemisphere
        ]
        db.get_one(StudySession, fine["sessions"][0]["id"]).hemisphere = Hemisphere.LEFT
    with transaction("test") as db:
        content = export_participant(db, participant_by_code(db, study, SYSTEM), SYSTEM)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        rows = list(csv.DictReader(io.StringIO(archive.read(f"{study}/sessions.csv").decode())))
        steps = list(csv.DictReader(io.StringIO(archive.read(f"{study}/steps.csv").decode())))
    problems = {int(r["session_id"]): r["problem"] for r in rows}
    assert "hemisphere" in problems[broken]
    assert problems[fine["sessions"][0]["id"]] == ""
    assert {int(r["session_id"]) for r in steps} == {fine["sessions"][0]["id"]}
