"""Known flaws of pinned packages fail `make check`; a list that cannot be asked is reported, and never taken for a clean answer."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from tests.packages import known_flaws
from tests.packages.known_flaws import CANARY, main, pinned
from tests.ports import free_port

FLAWS = {CANARY: ["PYSEC-1"], ("leaky", "1.0"): ["GHSA-1", "GHSA-2"], ("mended", "2.0"): ["GHSA-3"]}
SAID = {"GHSA-1": {"summary": "reads beyond its end"}, "GHSA-3": {"summary": "no flaw after all", "withdrawn": "2026-01-01T00:00:00Z"}}


class List(BaseHTTPRequestHandler):
    """The two questions of OSV's interface that are asked."""

    flaws: dict[tuple[str, str], list[str]] = FLAWS

    def do_POST(self) -> None:
        asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))["queries"]
        of = [self.flaws.get((q["package"]["name"], q["version"]), []) for q in asked if q["package"]["ecosystem"] == "PyPI"]
        self.answer({"results": [{"vulns": [{"id": number} for number in numbers]} if numbers else {} for numbers in of]})

    def do_GET(self) -> None:
        self.answer(SAID.get(self.path.rpartition("/")[2]))

    def answer(self, body: Any) -> None:
        self.send_response(200 if body else 404)
        self.end_headers()
        self.wfile.write(json.dumps(body).encode())

    def log_message(self, *_: Any) -> None:
        """Write nothing to the terminal."""


class Mirror(List):
    """A server that answers everything, and knows no flaws."""

    flaws: dict[tuple[str, str], list[str]] = {}


class Silent(List):
    """A server that takes a question and says nothing."""

    def do_POST(self) -> None:
        time.sleep(3)


@pytest.fixture
def lock(tmp_path: Path) -> Path:
    (tmp_path / "lock").write_text("# pinned\nleaky==1.0\nmended==2.0\nsound==3.0\n")
    return tmp_path / "lock"


@pytest.fixture
def address(request: pytest.FixtureRequest) -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), request.param)
    server.daemon_threads = True
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("address", [List], indirect=True)
def test_known_flaws_fail_and_are_named(
    address: str, lock: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["--lock", str(lock), "--address", address]) == 1
    told = capsys.readouterr().out
    assert "leaky 1.0: GHSA-1 reads beyond its end" in told
    assert "GHSA-2" in told  # it counts although its description is not there
    assert "GHSA-3" not in told  # withdrawn
    assert "the 3 pinned packages: 2" in told
    monkeypatch.setattr(known_flaws, "ACCEPTED", {"GHSA-1": "not called here", "GHSA-2": "not called here"})
    assert main(["--lock", str(lock), "--address", address]) == 0
    assert "pinned packages: none" in capsys.readouterr().out


@pytest.mark.parametrize("address", [Mirror, Silent], indirect=True)
def test_what_is_not_the_list_is_never_taken_for_a_clean_answer(
    address: str, lock: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(known_flaws, "PATIENCE_S", 1.0)
    assert main(["--lock", str(lock), "--address", address]) == 0
    assert "NOT CHECKED" in capsys.readouterr().out
    assert main(["--lock", str(lock), "--address", address, "--required"]) == 2


def test_a_machine_without_network_is_told_at_once(lock: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nobody = f"http://127.0.0.1:{free_port()}"
    began = time.monotonic()
    assert main(["--lock", str(lock), "--address", nobody]) == 0
    assert time.monotonic() - began < known_flaws.PATIENCE_S
    assert f"NOT CHECKED, {nobody}" in capsys.readouterr().out
    assert main(["--lock", str(lock), "--address", nobody, "--required"]) == 2


def test_every_pinned_package_is_asked_about() -> None:
    packages = dict(pinned(known_flaws.ROOT / "requirements.lock"))
    lines = [line for line in (known_flaws.ROOT / "requirements.lock").read_text().splitlines() if line.strip()]
    assert len(packages) == len(lines)
    assert {"fastapi", "sqlalchemy", "ast-serialize", "torch"} <= set(packages)


def test_make_check_asks() -> None:
    check = (known_flaws.ROOT / "Makefile").read_text().partition("\ncheck:")[2].partition("\n\n")[0]
    assert "tests/packages/known_flaws.py" in check
