"""Small files that ask for much, sent to a service in a process of its own: it is never restarted, and its memory stays bounded."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx2 as httpx
import pytest
from fastapi.testclient import TestClient

from tests.app.ingest.safety import hostile
from tests.app.learning.policies.test_foreign_policies import constant_of
from tests.ports import free_port

ROOT = Path(__file__).resolve().parents[4]
MOST_MB = 600
"""Of resident memory that the web process may have had at any moment."""


@pytest.fixture
def service(participant_code: str, make_token: Callable[[str], str]) -> Iterator[tuple[httpx.Client, subprocess.Popen[bytes]]]:
    """`betaloop serve` on the test's database, and a client of an engineer."""
    port = free_port()
    command = [sys.executable, "-m", "app.cli", "serve", "--port", str(port)]
    process = subprocess.Popen(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, stderr=subprocess.DEVNULL)
    headers = {"Authorization": f"Bearer {make_token('engineer')}"}
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=headers, timeout=900) as client:
            _wait_for(client)
            yield client, process
    finally:
        process.terminate()
        process.wait(300)


def _wait_for(client: httpx.Client) -> None:
    deadline = time.monotonic() + 180
    while True:
        try:
            client.get("/healthz").raise_for_status()
            return
        except httpx.HTTPError:
            assert time.monotonic() < deadline, "the service does not answer"
            time.sleep(0.2)


def peak_mb(pid: int) -> float:
    """Return the most resident memory that a process has had, MB."""
    line = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1000


@pytest.mark.slow
def test_hostile_files_end_as_sentences_and_the_web_process_keeps_its_memory(
    service: tuple[httpx.Client, subprocess.Popen[bytes]], client: TestClient
) -> None:
    there, process = service
    stated = {"participant": "P1", "visit": "1", "controller": "cdbs"}
    at_rest, told = peak_mb(process.pid), {}
    for name, content in hostile.every_file():
        begun = time.monotonic()
        answer = there.post("/api/v1/uploads", data=stated, files=[("file", (name, content))])
        assert answer.status_code in (201, 422), f"{name}: {answer.status_code} {answer.text[:300]}"
        assert process.poll() is None, name
        report = answer.json()["report"][0]
        told[name] = (report["problem"] or {}).get("what", "decoded")
        print(f"{name}: {len(content) / 1e6:.1f} MB, {time.monotonic() - begun:.1f} s, {peak_mb(process.pid):.0f} MB, {told[name]}")  # noqa: T201
        del content
    there.post("/api/v1/participants/P1/policies", data={"name": "x"}, files={"file": ("x.onnx", constant_of(400_000_000))})
    assert there.get("/healthz").status_code == 200
    assert told["the last.csv"] == "decoded"
    assert told["600 MB of packets.zip"] == "decoded"
    assert sum(words == "decoded" for words in told.values()) < 10
    assert peak_mb(process.pid) < MOST_MB, f"{at_rest:.0f} MB at rest"
