"""Nothing acknowledged is lost while processes are killed, on one machine's installation and on several processes over one PostgreSQL."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
import pytest

from app.platform.database import database_url

ROOT = Path(__file__).resolve().parents[2]


class Installed:
    """An installation of which the database alone is there."""

    def ask(self, query: str, *values: Any) -> list[Any]:
        with psycopg.connect(database_url().replace("+psycopg", "")) as connection:
            return connection.execute(query, values).fetchall()  # type: ignore[arg-type]


def test_what_was_acknowledged_and_is_not_there_is_found(
    fresh_database: str, client: Any, enrolled: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    writers = importlib.import_module("installed.writers")
    stated = {"participant": enrolled, "visit": "1", "controller": "random"}
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


KEPT = ("BETALOOP_SERVER_USER", "BETALOOP_JOB_NICENESS")


def ran(script: str, *arguments: str) -> dict[str, Any]:
    """The figures of a run that found nothing wrong."""
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
    # beside other work each process has its share of the cores alone
    assert figures["median_s"] < 10 * max(1.0, figures["load"] / (os.cpu_count() or 1))


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif(not sorted(Path("/usr/lib/postgresql").glob("*/bin")), reason="no PostgreSQL of the machine's own here")
def test_two_webs_and_three_workers_on_debians_postgresql_lose_and_double_nothing() -> None:
    figures = ran("benchmarks/soak.py", "--webs", "2", "--workers", "3", "--own", "--rounds", "8", "--minutes", "4")
    assert figures["kills"] >= 3
    assert figures["acknowledged"] > 50


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_under_load_no_request_fails_and_no_write_is_lost() -> None:
    figures = ran("-m benchmarks.development.load", "--quick")
    assert figures["errors"] == 0
    assert figures["acknowledged_writes"] >= 3
