"""The page of today, what the next visit waits for and who acts, the search, all jobs, and energy saved so far."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.analysis.pooled import Saved, overall
from app.learning.policies import constant_onnx
from app.overview.overview_web import SOON
from app.overview.state import Actor, Task, states
from app.platform.jobs import service as jobs
from app.settings import get_settings
from app.study.participation import ParticipantIn, enrol
from app.study.repository import participant_by_code
from app.tables.jobs import Job, JobStatus
from app.tables.participants import Participant
from app.tables.visits import Visit
from tests.app.analysis.conftest import adder
from tests.app.words import flat


def test_the_next_visit_waits_for_what_others_wait_for_and_says_who_acts(
    browser: TestClient, client: TestClient, session_id: int, db: Session
) -> None:
    today = datetime.now(UTC).date()
    day = today + timedelta(days=3)
    client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": day.isoformat()})
    page = browser.get("/").text
    row = next(r for r in re.findall(r"<tr>.*?</tr>", page, re.S) if day.isoformat() in r)
    assert "1 session without outcomes" in row
    assert "in 3 days" in row
    assert "clinician" in row
    client.put(f"/api/v1/sessions/{session_id}/qoc", json={"grasp_hz": 2.0, "rating": 7, "tremor_percent": 10.0})
    state = states(db, [participant_by_code(db, "P1", SYSTEM)], today)[1]
    assert state.blocked_by is not None
    assert (state.blocked_by.task, state.blocked_by.actor) == (Task.RANK, Actor.ENGINEER)


def test_the_next_visits_are_those_of_the_whole_study_whatever_page_of_participants_is_shown(
    browser: TestClient, participant_code: str, db: Session
) -> None:
    """Of 60 participants, 50 to a page: those of the second page are seen first."""
    today = datetime.now(UTC).date()
    for number in range(59):
        other = enrol(db, ParticipantIn.model_validate({"code": f"Q{number:02d}"}), SYSTEM)
        other.status = "withdrawn" if number == 58 else "active"
        db.flush()
        # the last by code comes first; each has another visit behind it
        db.add_all([Visit(participant_id=other.id, number=n, date=today + timedelta(days=n * (60 - number))) for n in (1, 2)])
    db.commit()
    for page in ("/", "/?offset=50"):
        text = browser.get(page).text
        card = text.split('id="board"')[1].split("</section>")[0]
        assert re.findall(r'<th scope="row"><a href="/participants/(\w+)">', card) == [f"Q{n:02d}" for n in range(57, 57 - SOON, -1)], page
        assert f"And {58 - SOON} later visits" in card
    assert ">Q58</a>" in browser.get("/?withdrawn=yes").text.split('id="board"')[1].split("</section>")[0]


@pytest.mark.parametrize(
    ("words", "leads_to"),
    [
        ("p1", "/participants/P1"),
        ("session {session}", "/sessions/{session}"),
        ("P1 {session}", "/sessions/{session}"),
        ("4f00", "/jobs/{job}"),
        ("constant half", "/participants/P1/policies/{policy}"),
        ("P1 HALF", "/participants/P1/policies/{policy}"),
    ],
)
def test_a_search_with_one_hit_opens_it(
    browser: TestClient, client: TestClient, session_id: int, db: Session, words: str, leads_to: str
) -> None:
    job = _job(db, JobStatus.SUCCEEDED)
    made = client.post(
        "/api/v1/participants/P1/policies", data={"name": "constant half"}, files={"file": ("a.onnx", constant_onnx(0.5, 10))}
    )
    assert made.status_code == 201, made.text
    found = browser.get("/search", params={"q": words.format(session=session_id)})
    assert found.status_code == 303
    assert found.headers["location"] == leads_to.format(session=session_id, job=job.id, policy=made.json()["id"])


def test_a_search_finds_nothing_beyond_the_callers_sites(sign_in: Callable[[str], TestClient], session_id: int, db: Session) -> None:
    viewer = sign_in("viewer")
    assert viewer.get("/search", params={"q": "P1"}).status_code == 303
    from app.tables.accounts import Membership, Site, User

    site = Site(study_id=1, code="other", name="Another clinic")
    db.add(site)
    db.flush()
    user = db.query(User).filter_by(email="viewer-page@clinic.example").one()
    db.query(Membership).filter_by(user_id=user.id).update({"site_id": site.id})
    db.commit()
    for words in ("P1", f"session {session_id}"):
        assert "Nothing is called" in viewer.get("/search", params={"q": words}).text


def test_all_jobs_stand_in_one_page_with_their_participant(browser: TestClient, participant_code: str, db: Session) -> None:
    _job(db, JobStatus.RUNNING)
    page = browser.get("/jobs").text
    assert "Running and waiting" in page
    assert f'<a href="/participants/{participant_code}/jobs">' in flat(page)
    assert 'action="/jobs/4f00aaaa-0000-4000-8000-000000000000/cancel"' in page
    assert 'data-confirm-yes="Stop the job" data-confirm-no="Let it run"' in page
    # a running job at 99.6 % is not done
    assert "99 %" in page
    assert "100 %" not in page


def test_jobs_at_work_stand_before_those_that_wait_in_the_order_in_which_they_begin(
    browser: TestClient, participant_code: str, db: Session
) -> None:
    waits = [_job(db, JobStatus.QUEUED, k) for k in (1, 2)]
    works = _job(db, JobStatus.RUNNING, 3)
    for minutes, job in zip((30, 20, 40), (*waits, works), strict=True):
        job.created_at = datetime.now(UTC) - timedelta(minutes=minutes)
    db.commit()
    page = browser.get("/jobs").text
    places = [page.index(f'action="/jobs/{job.id}/cancel"') for job in (works, *waits)]
    assert places == sorted(places)
    works.created_at = datetime.now(UTC)
    db.commit()
    page = browser.get("/jobs").text
    places = [page.index(f'action="/jobs/{job.id}/cancel"') for job in (works, *waits)]
    assert places == sorted(places), "whenever it was asked for"


def test_a_job_is_stopped_from_the_list_by_those_who_may_and_says_so(
    browser: TestClient, sign_in: Callable[[str], TestClient], participant_code: str, db: Session
) -> None:
    job = _job(db, JobStatus.RUNNING)
    job.cancel_requested_at = datetime.now(UTC)
    db.commit()
    for path in ("/jobs", f"/participants/{participant_code}/jobs", f"/jobs/{job.id}"):
        page = browser.get(path).text
        assert "stopping</span>" in page, path
        assert "/cancel" not in page, path
    job.cancel_requested_at = None
    db.commit()
    assert "/cancel" not in sign_in("viewer").get("/jobs").text
    assert browser.post(f"/jobs/{job.id}/cancel").status_code == 303
    page = browser.get("/jobs").text
    assert "cancelled</span>" in page
    assert f'Start one for <a href="/participants/{participant_code}/jobs">' in page


def test_the_page_of_energy_saved_has_the_number_that_the_home_page_takes_and_each_participants(
    browser: TestClient, db: Session, participant_code: str
) -> None:
    assert "No learned controller has run" in browser.get("/energy-saved").text
    add = adder(db, participant_code)
    add("rl", fraction=0.5, duration_s=600.0)
    add("distilled", fraction=0.8, duration_s=300.0)
    add("cdbs")
    add("random", fraction=0.1)
    add("rl", fraction=0.1, excluded="cable")
    page = browser.get("/energy-saved").text
    held = flat(page.split('id="energy-saved"')[1])
    # 1 - (0.25 * 10 min + 0.64 * 5 min) / 15 min
    assert re.search(r"Saved by learned controllers</dt><dd><b>62</b>", held)
    assert re.search(r"Over</dt><dd><b>15</b><span class=\"unit\">min</span><small>n = 2 sessions, 1 participant</small>", held)
    assert re.search(r'energy">P1</a></th><td class="num">62</td><td class="num">15</td><td class="num">2</td>', held)
    assert 'id="energy-saved" data-late' in browser.get("/").text


def test_energy_saved_is_weighted_by_minutes() -> None:
    both = overall([Saved("P1", 0.4, 30.0, 3), Saved("P2", 0.1, 10.0, 1)])
    assert both is not None
    assert (both.share, both.minutes, both.sessions) == (pytest.approx(0.325), 40.0, 4)
    assert overall([]) is None


def test_today_says_that_it_is_the_demo_there_alone(browser: TestClient, participant_code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "This is the demo" not in browser.get("/").text
    monkeypatch.setenv("BETALOOP_DEMO", "true")
    get_settings.cache_clear()
    page = browser.get("/").text
    assert "This is the demo" in page
    assert "simulated and not fitted to patients" in page
    assert "What would you test at P1&#39;s next visit?" in page
    assert "Participants still arrive" in page


def _job(db: Session, status: JobStatus, number: int = 0) -> Job:
    participant = db.query(Participant).filter_by(code="P1").one()
    now = datetime.now(UTC)
    ended = now if status == JobStatus.SUCCEEDED else None
    row = Job(
        id=f"4f00aaaa-0000-4000-8000-{number:012d}", participant_id=participant.id, kind="train", status=status, progress=0.996, params={},
        code_version=jobs.code_version(), created_by="test", started_at=now - timedelta(minutes=5), finished_at=ended,
    )  # fmt: skip
    db.add(row)
    db.commit()
    return row
