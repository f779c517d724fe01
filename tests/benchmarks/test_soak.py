"""Nothing acknowledged is lost while processes are killed, on one machine's installation and on several processes over one PostgreSQL."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import httpx2 as httpx
import numpy as np
import psycopg
import pytest

from app.platform.database import database_url

ROOT = Path(__file__).resolve().parents[2]
CORES = max(3, os.cpu_count() or 1)
"""No fewer than what a measurement keeps busy itself."""


class Installed:
    """An installation of which the database alone is there."""

    def ask(self, query: str, *values: Any) -> list[Any]:
        with psycopg.connect(database_url().replace("+psycopg", "")) as connection:
            return connection.execute(query, values).fetchall()  # type: ignore[arg-type]


def test_what_was_acknowledged_and_is_not_there_is_found(
    fresh_database: str, client: Any, participant_code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    writers = importlib.import_module("installed.writers")
    stated = {"participant": participant_code, "visit": "1", "controller": "random"}
    sent = client.post("/api/v1/uploads", data=stated, files={"file": ("s.csv", writers.table(np.random.default_rng(1)))}).json()
    session = sent["sessions"][0]["id"]
    assert client.put(f"/api/v1/sessions/{session}/qoc", json={"grasp_hz": 2.0}).status_code == 200
    study = writers.Study(1, 1, session, 1)
    right = writers.Acknowledged(uploads={sent["id"]: session}, qocs=[(session, 2.0)])
    assert writers.what_is_wrong(Installed(), right, study) == []
    wrong = writers.Acknowledged({sent["id"]: session, 999: 998}, [(session, 2.5)], ["an entry"], ["a job"])
    assert writers.what_is_wrong(Installed(), wrong, study) == [
        "acknowledged upload 999 is gone",
        "session 998 of acknowledged upload 999 is gone",
        f"QoC ({session}, 2.5) stands there 0 times",
        "entry an entry stands there 0 times",
        "acknowledged job a job is gone",
    ]


@pytest.mark.parametrize(("status", "is_a_fault"), [(500, True), (502, True), (503, False), (507, False), (200, False)])
def test_a_server_error_but_503_and_507_fails_a_run(
    fresh_database: str, monkeypatch: pytest.MonkeyPatch, status: int, is_a_fault: bool
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    writers = importlib.import_module("installed.writers")
    study = writers.Study(1, 1, 1, 1)
    callers = writers.Writers(Installed(), "a token", study)
    asked = httpx.Request("PUT", "http://127.0.0.1/api/v1/sessions/1/qoc")
    callers._once(lambda: httpx.Response(status, text="what it says", request=asked))
    found = writers.what_is_wrong(Installed(), callers.said, study)
    assert found == [f"a request was answered with a server error: PUT /api/v1/sessions/1/qoc: {status} what it says"] * is_a_fault


def test_a_request_for_a_job_that_is_on_its_way_is_answered_before_no_more_are_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    """Requests that begin after the last jobs were counted would run when the installation is stopped, and look lost."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    writers = importlib.import_module("installed.writers")
    callers = writers.Writers(Installed(), "a token", writers.Study(1, 1, 1, 1))
    sent, answered = threading.Event(), threading.Event()

    def service(request: httpx.Request) -> httpx.Response:
        if request.method == "GET":
            return httpx.Response(200, json={"items": []})
        sent.set()
        answered.wait(60)
        return httpx.Response(202, json={"id": "a job"})

    with httpx.Client(transport=httpx.MockTransport(service), base_url="http://betaloop") as caller:
        work = threading.Thread(target=callers._jobs, args=(caller,))
        work.start()
        assert sent.wait(60)
        with pytest.raises(RuntimeError, match="a request for a job was not answered within 0 s"):
            callers.stop_jobs(0.1)
        answered.set()
        callers.stop_jobs()
        assert callers.said.jobs == ["a job"]
        callers._jobs(caller)
        assert callers.said.jobs == ["a job"]
        work.join()


@pytest.mark.parametrize(
    ("seconds", "load", "late"), [(9.9, 0.5, 0), (10.0, 0.5, 1), (10.0, 2.4, 1), (25.0, 4 * CORES, 0), (49.0, 4 * CORES, 1)]
)
def test_who_is_not_healthy_within_10_s_is_late_and_the_load_of_others_counts(
    monkeypatch: pytest.MonkeyPatch, seconds: float, load: float, late: int
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.syspath_prepend(str(ROOT))
    soak = importlib.import_module("benchmarks.soak")
    run = soak.Soak(None, None, 0.0)
    run.took("web", seconds, load)
    assert len(run.late) == late
    assert (run.shares[0] >= 1) == bool(late)


@pytest.mark.parametrize(("p95", "load", "wrong"), [(0.99, 1.0, 0), (1.01, 1.0, 1), (1.01, 4 * CORES, 0), (4.1, 4 * CORES, 1)])
def test_answers_that_take_more_than_a_second_fail_a_run_and_the_load_of_others_counts(
    monkeypatch: pytest.MonkeyPatch, p95: float, load: float, wrong: int
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.syspath_prepend(str(ROOT))
    loads = importlib.import_module("benchmarks.load")
    found = loads.Found(seconds={"today": [p95] * 20})
    figures = loads.report(found, load)
    assert len(loads.too_slow(figures)) == wrong
    assert (figures["p95_share"] >= 1) == bool(wrong)


KEPT = ("BETALOOP_SERVER_USER", "BETALOOP_JOB_NICENESS")


def ran(script: str, *arguments: str) -> dict[str, Any]:
    """Run a script that must find nothing wrong; return its figures."""
    env = {k: v for k, v in os.environ.items() if not k.startswith("BETALOOP_") or k in KEPT} | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *script.split(), *arguments], cwd=ROOT, env=env, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return dict(json.loads(done.stdout.splitlines()[-1]))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_kills_of_every_process_lose_and_double_nothing() -> None:
    figures = ran("benchmarks/soak.py", "--quick")
    assert figures["kills"] >= 3
    assert figures["acknowledged"] > 50
    assert figures["longest_share"] < 1, "of 10 s; beside other work each process has its share of the cores alone"


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif(not sorted(Path("/usr/lib/postgresql").glob("*/bin")), reason="no PostgreSQL of the machine's own here")
def test_two_webs_and_three_workers_on_debians_postgresql_lose_and_double_nothing() -> None:
    figures = ran("benchmarks/soak.py", "--webs", "2", "--workers", "3", "--own", "--rounds", "8", "--minutes", "4")
    assert figures["kills"] >= 3
    assert figures["acknowledged"] > 50
    assert figures["longest_share"] < 1


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_under_load_no_request_fails_and_no_write_is_lost() -> None:
    figures = ran("benchmarks/load.py", "--quick")
    assert figures["errors"] == 0
    assert figures["p95_share"] < 1, "of 1 s; beside other work each answer has its share of the cores alone"
    assert figures["acknowledged_writes"] >= 3
