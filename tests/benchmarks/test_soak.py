"""Nothing acknowledged is lost while processes are killed, on one machine's installation and on several processes over one PostgreSQL."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def ran(script: str, *arguments: str) -> dict[str, Any]:
    """The figures of a run that found nothing wrong."""
    env = {k: v for k, v in os.environ.items() if not k.startswith("BETALOOP_") or k == "BETALOOP_SERVER_USER"} | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(ROOT / "benchmarks" / script), *arguments]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return dict(json.loads(done.stdout.splitlines()[-1]))


def test_kills_of_every_process_lose_and_double_nothing() -> None:
    figures = ran("soak.py", "--quick")
    assert figures["kills"] >= 3
    assert figures["acknowledged"] > 50
    assert figures["median_s"] < 10


@pytest.mark.skipif(not sorted(Path("/usr/lib/postgresql").glob("*/bin")), reason="no PostgreSQL of the machine's own here")
def test_two_webs_and_three_workers_on_debians_postgresql_lose_and_double_nothing() -> None:
    figures = ran("soak.py", "--webs", "2", "--workers", "3", "--own", "--rounds", "8", "--minutes", "4")
    assert figures["kills"] >= 3
    assert figures["acknowledged"] > 50


def test_under_load_no_request_fails_and_no_write_is_lost() -> None:
    figures = ran("load.py", "--quick")
    assert figures["errors"] == 0
    assert figures["acknowledged_writes"] >= 3
