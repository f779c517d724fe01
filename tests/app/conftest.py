"""Sessions as a clinic uploads them (beta follows an autoregression that the amplitude pushes down), and a worker for their jobs."""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from numpy.typing import NDArray
from sqlalchemy import event, make_url, text

from app.platform.database import database_url, get_engine, new_session
from app.platform.embedded.server import EmbeddedPostgres
from app.settings import get_settings
from tests import between_workers
from tests.app.every_route import World
from tests.between_workers import one_at_a_time
from tests.conftest import Template, close_connections, copy_database, copy_of, drop_database, own_database
from tests.s3_server import CREDENTIALS, Server

ROOT = Path(__file__).resolve().parents[2]
Upload = Callable[..., int]


def table(amplitude: NDArray[np.float64], rng: np.random.Generator, lead: int = 10) -> str:
    """Write a CSV of one session: `lead` rows before its start, then one row per amplitude."""
    driven = np.concatenate([np.full(lead, amplitude[0]), amplitude])
    beta, level = np.empty(driven.size), 1.2
    for i, a in enumerate(driven):
        level = 0.8 * level + 0.2 * (1.6 - 0.9 * a) + 0.1 * rng.standard_normal()
        beta[i] = max(level, 0.05)
    sink = io.StringIO()
    sink.write("t_s,beta,amplitude_fraction\n")
    for i, (b, a) in enumerate(zip(beta, driven, strict=True)):
        sink.write(f"{2 * (i - lead + 1)},{b:.5f},{a:.4f}\n")
    return sink.getvalue()


@pytest.fixture(scope="session")
def full_study(server: EmbeddedPostgres, application: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Template, World]:
    """A study in use with a row for every route, made once by one of the workers of a run."""
    data = tmp_path_factory.mktemp("full") / "data"
    several = "PYTEST_XDIST_WORKER" in os.environ
    folder = tmp_path_factory.getbasetemp().parent / "filled" if several else tmp_path_factory.mktemp("filled")
    with one_at_a_time(folder), pytest.MonkeyPatch.context() as patch, own_database(server, data, patch, "betaloop", keep="filled"):
        database = str(make_url(database_url()).database)
        known = between_workers.take(server, database, data, folder)
        world = World(application, known)
        if known is None and several:
            between_workers.give(server, database, data, world.state(), folder)
    return ("filled", data), world


@pytest.fixture
def world(full_study: tuple[Template, World], server: EmbeddedPostgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    """The study, with calls for every route."""
    template, world = full_study
    with copy_of(template, server, tmp_path, monkeypatch):
        yield world


@dataclass(frozen=True)
class Beginning:
    """A study as several tests begin with it.

    Attributes:
        template: its database and files. token: of the administrator. state: of the numbers that are drawn next. made: what its maker gave.
        written: what had been written before it was made, as (entity, action).
    """

    template: Template
    token: str
    state: Any
    made: Any
    written: list[tuple[str, str]]


@pytest.fixture(scope="session")
def beginnings() -> dict[str, Beginning]:
    """By name, those that this process has made."""
    return {}


@pytest.fixture
def rng() -> np.random.Generator:
    """Generator that uploads draw from."""
    return np.random.default_rng(20)


def _written() -> list[tuple[str, str]]:
    """List every change of the database in use so far."""
    with new_session() as db:
        return [(entity, action) for entity, action in db.execute(text("select entity, action from audit_event order by id"))]


@pytest.fixture
def begin_with(
    server: EmbeddedPostgres,
    client: TestClient,
    rng: np.random.Generator,
    beginnings: dict[str, Beginning],
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[str, Callable[[], Any]], Any]:
    """Function that makes a study, or copies the one that an earlier test of this process made under the same name in a tenth of the time.

    What a test writes before it would be lost by the copy, or kept for every later test, so that it is refused.
    """

    def begin(name: str, make: Callable[[], Any]) -> Any:
        own, data = make_url(database_url()).database, get_settings().data_dir
        assert own is not None
        written = _written()
        if name not in beginnings:
            made = make()
            kept = tmp_path_factory.mktemp(name) / "data"
            close_connections()
            shutil.copytree(data, kept)
            drop_database(server, name)  # of a making that was cut short
            copy_database(server, name, own)
            beginnings[name] = Beginning((name, kept), client.headers["authorization"], rng.bit_generator.state, made, written)
        else:
            before = beginnings[name].written
            assert written == before, f"ask for {name} before anything else is written: {written}, where it was made {before}"
            close_connections()
            drop_database(server, own)
            copy_database(server, own, name)
            shutil.rmtree(data, ignore_errors=True)
            shutil.copytree(beginnings[name].template[1], data)
            client.headers["authorization"] = beginnings[name].token
            rng.bit_generator.state = beginnings[name].state
        return deepcopy(beginnings[name].made)

    return begin


@pytest.fixture
def upload(client: TestClient, participant_code: str, rng: np.random.Generator) -> Upload:
    """Function that uploads a session of P1, enters its QoCs and returns its id."""

    def send(
        controller: str = "random",
        steps: int = 60,
        visit: int = 1,
        level: float = 1.0,
        qoc: dict[str, Any] | None = None,
        lead: int = 10,
        **fields: Any,
    ) -> int:
        amplitude = rng.uniform(0.3, 1.0, steps) if controller == "random" else np.full(steps, level)
        answer = client.post(
            "/api/v1/uploads",
            data={"participant": participant_code, "visit": visit, "controller": controller, **fields},
            files={"file": (f"{controller}-{rng.integers(10**9)}.csv", table(amplitude, rng, lead), "text/csv")},
        )
        assert answer.status_code == 201, answer.text
        session_id = int(answer.json()["sessions"][0]["id"])
        values = {"grasp_hz": 2.0, "rating": 7, "tremor_percent": 10.0} if qoc is None else qoc
        if values:
            assert client.put(f"/api/v1/sessions/{session_id}/qoc", json=values).status_code == 200
        return session_id

    return send


@pytest.fixture
def worker(fresh_database: str) -> Iterator[None]:
    """A worker in a process of its own, on the test's database."""
    code = (
        "import signal, sys, threading; from app.platform.jobs.worker import run_worker; stop = threading.Event();"
        "signal.signal(signal.SIGTERM, lambda *_: stop.set()); run_worker(2, stop)"
    )
    log = get_settings().data_dir / "worker.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as out:
        process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=out, stderr=out)
    yield
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@pytest.fixture
def ended(client: TestClient) -> Callable[[str, float], dict[str, Any]]:
    """Wait for a job's end."""

    def wait(job_id: str, timeout_s: float = 60.0) -> dict[str, Any]:
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            job: dict[str, Any] = client.get(f"/api/v1/jobs/{job_id}").json()
            if job["finished_at"]:
                return job
            time.sleep(0.2)
        raise AssertionError(
            f"the job did not end within {timeout_s} s: {job}\n{(get_settings().data_dir / 'worker.log').read_text()[-3000:]}"
        )

    return wait


@pytest.fixture
def statements() -> Iterator[list[str]]:
    """Queries of the service to the database."""
    asked: list[str] = []

    def note(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        asked.append(statement)

    event.listen(get_engine(), "before_cursor_execute", note)
    yield asked
    event.remove(get_engine(), "before_cursor_execute", note)


@pytest.fixture(scope="module")
def s3_server() -> Iterator[Server]:
    """An S3 server for the tests of one file."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in CREDENTIALS.items():
            patch.setenv(name, value)
        running = Server()
        yield running
        running.stop()
