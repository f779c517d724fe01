"""The image holds what the service needs, at the versions that were tested, and no tools of tests."""

from __future__ import annotations

from pathlib import Path

from tests.service_lock import pinned, service_lock

ROOT = Path(__file__).resolve().parents[1]


def test_the_lock_of_the_image_is_the_service_s_part_of_the_whole() -> None:
    held = (ROOT / "requirements-service.lock").read_text()
    assert held == service_lock(), "run `make lock`"
    names = {line.split("==")[0].lower() for line in held.splitlines()}
    assert not names & {"pytest", "playwright", "hypothesis", "schemathesis", "mypy", "ruff", "d3rlpy", "pip"}
    assert names >= {"fastapi", "sqlalchemy", "torch", "uvicorn", "dbos", "pynwb"}
    assert set(held.splitlines()) <= set(pinned().values())


def test_the_image_installs_that_lock_alone() -> None:
    image = (ROOT / "Dockerfile").read_text()
    assert "pip install --no-cache-dir -r requirements-service.lock" in image
    assert "requirements.lock" not in image
