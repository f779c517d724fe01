"""The image holds what the service needs, at the versions that were tested, and no tools of tests."""

from __future__ import annotations

from pathlib import Path

from tests.packages.service_lock import LOCK, held, service_packages

ROOT = Path(__file__).resolve().parents[2]


def test_the_lock_of_the_image_is_the_service_s_part_of_the_whole_with_a_hash_each() -> None:
    lines = held()
    assert list(lines) == service_packages(), "run `make lock`"
    assert [line for line, hashes in lines.items() if len(hashes) != 1] == []
    names = {line.split("==")[0].lower() for line in lines}
    assert not names & {"pytest", "playwright", "hypothesis", "schemathesis", "mypy", "ruff", "moto", "flask", "d3rlpy", "pip"}
    assert names >= {"fastapi", "sqlalchemy", "torch", "uvicorn", "dbos", "pynwb", "authlib", "s3fs"}


def test_the_image_installs_that_lock_alone() -> None:
    image = (ROOT / "Dockerfile").read_text()
    assert "pip install --no-cache-dir --require-hashes --no-deps -r requirements-service.lock" in image
    assert "requirements.lock" not in image


def test_where_packages_come_from_is_named_by_who_builds_the_image() -> None:
    for path in (LOCK, ROOT / "requirements.lock"):
        assert [line for line in path.read_text().splitlines() if line.startswith("-") or "://" in line] == [], path.name
    image = (ROOT / "Dockerfile").read_text()
    assert image.index("ARG PIP_EXTRA_INDEX_URL") < image.index("pip install")
