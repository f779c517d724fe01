"""Log of an error: where it was raised, and no value of any variable."""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterator
from contextlib import suppress

import pytest
import structlog
import typer
from fastapi.testclient import TestClient

from app import cli, main
from app.main import create_app
from app.platform import logs
from app.settings import get_settings

PATIENT = "-".join(("NAME", "OF", "PATIENT"))  # put together, for a traceback quotes lines of source


@pytest.fixture(autouse=True)
def as_libraries_have_it() -> Iterator[None]:
    """Logging as it is before betaloop has set it up; set up as for every other test at the end."""
    structlog.reset_defaults()
    yield
    get_settings.cache_clear()
    logs.configure_own()


def fail() -> None:
    named = PATIENT
    raise ValueError(f"a name of {len(named)} letters")


@pytest.mark.parametrize("as_json", [False, True], ids=["text", "json"])
def test_a_service_logs_an_error_with_a_plain_traceback(
    as_json: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("BETALOOP_LOG_JSON", str(as_json))
    get_settings.cache_clear()
    service = create_app()
    service.get("/broken")(fail)
    answer = TestClient(service, raise_server_exceptions=False).get("/broken")
    assert answer.status_code == 500
    printed = capsys.readouterr()
    assert "a name of 15 letters" in printed.err
    assert "in fail" in printed.err
    assert PATIENT not in printed.out + printed.err
    assert printed.err.lstrip().startswith("{") == as_json


def test_a_command_logs_an_error_with_a_plain_traceback(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    commands = typer.Typer()

    @commands.command()
    def read() -> None:
        try:
            fail()
        except ValueError:
            structlog.get_logger().exception("could not be read")

    monkeypatch.setattr(cli, "_end_in_order_on_signals", lambda: None)
    monkeypatch.setattr(cli, "app", lambda **_: commands([], standalone_mode=False))
    cli.main()
    printed = capsys.readouterr()
    assert "in fail" in printed.err
    assert PATIENT not in printed.out + printed.err


@pytest.mark.usefixtures("fresh_database")
def test_a_log_on_a_full_disk_loses_lines_and_no_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    service = create_app()
    monkeypatch.setattr(main, "check_connection", fails)
    with open("/dev/full", "w", buffering=1) as full:
        monkeypatch.setattr(sys, "stderr", full)
        with pytest.raises(OSError):
            print("this cannot be written", file=full)
        answer = TestClient(service).get("/healthz")
        with suppress(OSError):
            full.close()
    assert (answer.status_code, answer.json()["title"]) == (507, "The disk is full")
