"""The compose file and the image, without Docker: the file against its schema, its commands as processes on a PostgreSQL of the tests.

The schema (tests/data/compose_spec.json) is that of the Compose Specification, as docker-compose 1.29.2 has it (Apache License 2.0).
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft201909Validator

from app.platform.embedded.server import EmbeddedPostgres
from app.settings import Settings
from tests.conftest import own_database
from tests.ports import free_port

ROOT = Path(__file__).resolve().parents[1]
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
IMAGE = (ROOT / "Dockerfile").read_text()
OURS = ("migrate", "web", "worker")
STARTED_WITHIN_S = 150.0


def problems(compose: Any) -> list[str]:
    schema = json.loads((ROOT / "tests" / "data" / "compose_spec.json").read_text())
    return [f"{error.json_path}: {error.message}" for error in Draft201909Validator(schema).iter_errors(compose)]


def test_the_file_is_as_the_specification_has_it() -> None:
    assert problems(COMPOSE) == []
    assert problems(COMPOSE | {"services": SERVICES | {"web": SERVICES["web"] | {"comand": []}}}) != []


def test_every_name_in_it_exists() -> None:
    fields = {f"BETALOOP_{name.upper()}" for name in Settings.model_fields}
    for name, service in SERVICES.items():
        assert set(service.get("depends_on", {})) <= set(SERVICES), name
        assert {mount.split(":")[0] for mount in service["volumes"]} <= set(COMPOSE["volumes"]), name
        if name in OURS:
            assert set(service["build"]["args"]) <= set(re.findall(r"^ARG (\w+)$", IMAGE, re.MULTILINE)), name
            assert set(service["environment"]) <= fields | {"FORWARDED_ALLOW_IPS"}, name
            assert "files:/data" in service["volumes"], "every service of ours reads and writes the same files and keys"
    asked = set(re.findall(r"\$\{(\w+):\?", (ROOT / "docker-compose.yml").read_text()))
    assert asked == {"POSTGRES_PASSWORD", "SERVICE_PASSWORD", "TORCH_INDEX"}
    told = (ROOT / "docker-compose.yml").read_text().split("services:")[0]
    assert all(name in told for name in asked), "the head of the file says what to put into .env"


def test_people_sign_in_over_https_alone_unless_somebody_says_otherwise() -> None:
    for name in OURS:
        stated = SERVICES[name]["environment"]
        assert stated.get("BETALOOP_COOKIE_SECURE") is None, f"{name}: the file itself says nothing, so the service's own default holds"
    assert "BETALOOP_COOKIE_SECURE" in SERVICES["web"]["environment"], "it can be said in .env"
    assert all(port.startswith("127.0.0.1:") for port in SERVICES["web"]["ports"]), "what is published is for this machine, or its proxy"
    told = (ROOT / "docker-compose.yml").read_text().split("services:")[0]
    assert all(word in told for word in ("TLS", "FORWARDED_ALLOW_IPS", "BETALOOP_COOKIE_SECURE=false"))


def test_the_image_holds_what_runs_and_is_nobody_s_root() -> None:
    for copied in re.findall(r"^COPY (.+) \S+$", IMAGE, re.MULTILINE):
        assert all((ROOT / path).exists() for path in copied.split()), copied
    assert {"app", "ml", "migrations", "static"} <= set(" ".join(re.findall(r"^COPY (.+) \S+$", IMAGE, re.MULTILINE)).split())
    assert IMAGE.index("USER betaloop") < IMAGE.index("CMD")
    assert "BETALOOP_DATA_DIR=/data" in IMAGE
    assert json.loads(re.findall(r"^CMD (.+)$", IMAGE, re.MULTILINE)[0]) == SERVICES["web"]["command"]
    assert "pip install --no-cache-dir --no-deps --no-build-isolation -e ." in IMAGE


@pytest.fixture
def empty(server: EmbeddedPostgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """Environment of the compose file's services, on a database of the tests that holds nothing yet."""
    with own_database(server, tmp_path / "data", monkeypatch, "template0"):
        held = {k: v for k, v in os.environ.items() if not k.startswith("BETALOOP_") or k == "BETALOOP_SERVER_USER"}
        yield held | {"BETALOOP_DATA_DIR": str(tmp_path / "data"), "PYTHONPATH": str(ROOT)}


def started(name: str, env: dict[str, str], log: Path) -> subprocess.Popen[bytes]:
    service = SERVICES[name]
    named = {key: os.environ[key] for key in service["environment"] if key.endswith("_URL")}
    assert service["command"][0] == "betaloop"
    with log.open("wb") as out:
        return subprocess.Popen(
            [sys.executable, "-m", "app.cli", *service["command"][1:]], cwd=ROOT, env=env | named, stdout=out, stderr=out
        )


def healthy(port: int) -> bool:
    """Check the web service's health as the compose file does."""
    kind, program, *rest = SERVICES["web"]["healthcheck"]["test"]
    assert (kind, program) == ("CMD", "python")
    asked = [word.replace(":8000/", f":{port}/") for word in rest]
    assert asked != rest
    return subprocess.run([sys.executable, *asked], capture_output=True, check=False).returncode == 0


@pytest.mark.slow
def test_its_commands_run_in_their_order(empty: dict[str, str], tmp_path: Path) -> None:
    log = tmp_path / "said.txt"
    assert started("migrate", empty, log).wait(STARTED_WITHIN_S) == 0, log.read_text()
    port = free_port()
    env = empty | {"BETALOOP_PORT": str(port)}
    assert not healthy(port)
    web, worker = started("web", env, tmp_path / "web.txt"), started("worker", env, tmp_path / "worker.txt")
    try:
        deadline = time.monotonic() + STARTED_WITHIN_S
        while not (healthy(port) and "takes jobs" in (tmp_path / "worker.txt").read_text()):
            assert web.poll() is None, (tmp_path / "web.txt").read_text()
            assert worker.poll() is None, (tmp_path / "worker.txt").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.2)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=10) as answer:
            assert json.loads(answer.read())["status"] == "ready"
            assert answer.headers["Strict-Transport-Security"], "with what the file says alone, browsers are told to use HTTPS"
    finally:
        for process in (web, worker):
            process.terminate()
        for process in (web, worker):
            process.wait(30)
