"""While the job of the first ranking runs: pages, API and terminal say how far it is, and none asks to start it."""

from __future__ import annotations

import html
import io
import time
from collections.abc import Callable
from datetime import timedelta

import pytest
from fastapi.testclient import TestClient
from rich.console import Console

from app.platform.database import now, transaction
from app.platform.numbers import minutes_left, time_left
from app.simulation.demo import command, loader
from app.tables.jobs import Job, JobStatus

PAGES = ("/", "/participants/P1", "/participants/P1/ranking")


@pytest.fixture
def pipeline(client: TestClient, participant_code: str, upload: Callable[..., int]) -> str:
    """A pipeline that was started a minute ago."""
    for controller in ("random", "cdbs"):
        upload(controller)
    answer = client.post("/api/v1/participants/P1/jobs", json={"kind": "pipeline", "preset": "quick"})
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


def reach(job_id: str, progress: float, elapsed_s: float = 60.0) -> None:
    with transaction("test") as db:
        job = db.get_one(Job, job_id)
        job.status, job.progress, job.started_at, job.message = (
            JobStatus.RUNNING,
            progress,
            now() - timedelta(seconds=elapsed_s),
            "Fit DLSM",
        )


def page(client: TestClient, path: str) -> str:
    return html.unescape(client.get(path, headers={"Accept": "text/html"}).text)


@pytest.mark.parametrize("path", PAGES)
def test_pages_say_how_far_the_first_ranking_is(client: TestClient, pipeline: str, path: str) -> None:
    assert "waits for a worker" in page(client, path)
    reach(pipeline, 0.02)
    assert "time left not known yet" in page(client, path)
    reach(pipeline, 0.25)
    text = page(client, path)
    assert "25 %" in text
    assert "Fit DLSM" not in text, "what the job does just now is for its own page"
    assert "about 4 min left" in text  # 60 s for a quarter leave a little more than 180 s for the rest


def test_no_page_asks_for_the_job_that_runs(client: TestClient, pipeline: str) -> None:
    for path in PAGES:
        text = page(client, path)
        assert "Start a job of kind" not in text
        assert "one evaluation of this participant" not in text
    assert 'id="ranking" class="stack" data-refresh=' in page(client, "/participants/P1/ranking")
    with transaction("test") as db:
        job = db.get_one(Job, pipeline)
        job.status, job.finished_at, job.error = JobStatus.FAILED, now(), "stopped by the test"
    text = page(client, "/participants/P1/ranking")
    assert "Not enough data" in text
    assert 'id="ranking" class="stack" data-refresh=' not in text
    assert "First ranking" not in page(client, "/")


def test_the_api_gives_the_time_left(client: TestClient, pipeline: str) -> None:
    assert client.get(f"/api/v1/jobs/{pipeline}").json()["seconds_left"] is None
    reach(pipeline, 0.5, 100.0)
    assert client.get(f"/api/v1/jobs/{pipeline}").json()["seconds_left"] == pytest.approx(100.0, abs=10.0)


def test_remaining_times_are_words() -> None:
    assert [minutes_left(s) for s in (0.0, 59.9, 60.0, 61.0, 600.0, 7200.0, 20_000.0)] == [
        "less than a minute left",
        "less than a minute left",
        "about 1 min left",
        "about 2 min left",
        "about 10 min left",
        "about 120 min left",
        "about 6 h left",
    ]
    assert (time_left(None), time_left(61.0)) == ("time left not known yet", "about 2 min left")


def job(status: str, progress: float, left: float | None) -> dict[str, object]:
    steps = [
        {"key": "fit", "title": "Fit DLSM", "status": "succeeded" if progress >= 0.5 else "running", "progress": min(1.0, 2 * progress)}
    ]
    return {"status": status, "progress": progress, "seconds_left": left, "steps": steps}


@pytest.mark.parametrize("terminal", [True, False])
def test_the_terminal_says_how_far_it_is(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(loader, "_LINE_S", 0.0)
    jobs = [job("queued", 0.0, None), job("running", 0.02, None), job("running", 0.5, 150.0), job("succeeded", 1.0, None)]

    def come():  # type: ignore[no-untyped-def]
        for one in jobs:
            yield one
            time.sleep(0.15)  # a terminal is drawn ten times a second

    last = loader.show(Console(file=out, width=80, force_terminal=terminal), come())
    assert last["status"] == "succeeded"
    said = out.getvalue()
    for words in ("First ranking", "waits for the worker", "time left not known yet", "about 3 min left", "Fit DLSM"):
        assert words in said


@pytest.mark.parametrize("terminal", [True, False])
def test_the_password_stays_beside_its_label(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(command, "console", Console(file=out, width=80, force_terminal=terminal, color_system=None))
    command.say_welcome("http://a-long-name-of-a-machine.of-a-clinic.example:8000", 12.3, "beta-0123abcd")
    lines = out.getvalue().splitlines()
    assert any(line.strip() == "password: beta-0123abcd" for line in lines)
    assert any(line.strip() == "address:  http://a-long-name-of-a-machine.of-a-clinic.example:8000" for line in lines)
    assert all(len(line) <= 80 for line in lines if "sign in" in line or "password" in line)
