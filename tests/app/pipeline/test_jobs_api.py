"""Jobs over REST: when they start, how they are followed, cancelled and repeated."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.estimates.service import policies_to_rank
from app.evaluation.methods import default_methods
from app.evaluation.schemas import EvaluateParams
from app.learning.policies import constant_onnx
from app.learning.schemas import DEFAULT_SWEEP
from app.platform import files
from app.study.repository import participant_by_code
from app.tables.learning import Policy

Upload = Callable[..., int]
JOBS = "/api/v1/participants/P1/jobs"


def add_policy(client: TestClient, name: str = "ext") -> int:
    answer = client.post("/api/v1/participants/P1/policies", data={"name": name}, files={"file": ("e.onnx", constant_onnx(0.6, 10))})
    return int(answer.json()["id"])


def test_no_job_starts_without_a_threshold_and_the_answer_suggests_one(client: TestClient, upload: Upload) -> None:
    upload("cdbs")
    client.put("/api/v1/participants/P1/settings", json={"settings": {"xi_beta": None}})
    answer = client.post(JOBS, json={"kind": "pipeline"})
    assert answer.status_code == 422
    assert "xi_beta" in answer.json()["hint"]
    assert 0 < answer.json()["suggested_xi_beta"] < 2
    assert client.get(JOBS).json()["total"] == 0


def test_methods_of_the_answer_run_where_none_are_named_and_named_ones_run_once(client: TestClient, upload: Upload) -> None:
    upload("random")
    quick = client.post(JOBS, json={"kind": "pipeline", "preset": "quick"}).json()
    assert quick["params"]["methods"] == default_methods() == ["linear", "impulse", "posterior"]
    assert {name: quick["params"][name] for name in DEFAULT_SWEEP} == DEFAULT_SWEEP, "the sweep of the demo, whoever starts it"
    named = client.post(JOBS, json={"kind": "pipeline", "preset": "quick", "methods": ["dual_dice", "wis", "dual_dice"]}).json()
    assert named["params"]["methods"] == ["dual_dice", "wis"]


def test_no_job_starts_without_a_usable_session(client: TestClient, participant_code: str) -> None:
    answer = client.post(JOBS, json={"kind": "train"})
    assert answer.status_code == 422
    assert "no session that policies can learn from" in answer.json()["detail"]
    assert client.get(JOBS).json()["total"] == 0


@pytest.mark.parametrize("window", [{"window": 10}, {}], ids=["window on its row", "window in its file"])
@pytest.mark.parametrize("named", [False, True], ids=["every policy", "a named policy"])
def test_no_evaluation_starts_where_a_policy_s_file_is_missing(
    client: TestClient, upload: Upload, db: Session, named: bool, window: dict[str, int]
) -> None:
    upload("random")
    policy = db.get_one(Policy, add_policy(client))
    policy.config = window
    db.commit()
    files.path_of(policy.onnx_sha256).unlink()
    answer = client.post(JOBS, json={"kind": "evaluate"} | ({"policies": [policy.id]} if named else {}))
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert "policy 'ext' is missing or damaged" in answer.json()["detail"]
    assert "backup" in answer.json()["hint"]
    assert client.get(JOBS).json()["total"] == 0


def test_a_job_is_accepted_with_its_defaults_and_listed(client: TestClient, upload: Upload) -> None:
    upload("random")
    answer = client.post(JOBS, json={"kind": "pipeline"})
    assert answer.status_code == 202
    body = answer.json()
    assert (body["status"], body["progress"], body["participant"], body["created_by"]) == ("queued", 0.0, "P1", "admin@clinic.example")
    assert (body["params"]["count"], body["params"]["preset"]) == (6, "full")
    assert body["params"]["methods"] == default_methods()
    assert client.get(f"/api/v1/jobs/{body['id']}").json() == body
    assert client.get(JOBS).json()["items"] == [body]
    assert client.get(JOBS, params={"status": "running"}).json()["total"] == 0


@pytest.mark.parametrize(
    ("body", "status", "named"),
    [
        ({"kind": "dance"}, 422, "kind"),
        ({"kind": "train", "count": "6"}, 422, "count"),
        ({"kind": "train", "updates": 0}, 422, "updates"),
        ({"kind": "train", "surprise": 1}, 422, "surprise"),
        ({"kind": "distill", "policies": [999]}, 404, "999"),
        ({"kind": "distill"}, 422, "no trained policy"),
        ({"kind": "evaluate"}, 422, "There is no policy yet"),
        ({"kind": "evaluate", "policies": [999]}, 404, "999"),
        ({"kind": "evaluate", "methods": ["magic"]}, 422, "methods"),
        ({"kind": "evaluate", "methods": ["wis", "aggregate"]}, 422, "at least two other methods"),
    ],
    ids=lambda v: str(v)[:40],
)
def test_what_cannot_run_is_refused_before_it_waits(
    client: TestClient, upload: Upload, body: dict[str, Any], status: int, named: str
) -> None:
    upload("random")
    answer = client.post(JOBS, json=body)
    assert answer.status_code == status
    assert named in answer.text
    assert client.get(JOBS).json()["total"] == 0


def test_only_policies_trained_here_are_fine_tuned(client: TestClient, upload: Upload) -> None:
    upload("random")
    answer = client.post(JOBS, json={"kind": "train", "policies": [add_policy(client)]})
    assert answer.status_code == 422
    assert "only policies trained here" in answer.json()["detail"]


def test_a_viewer_starts_and_cancels_nothing(client: TestClient, client_as: Callable[[str], TestClient], upload: Upload) -> None:
    upload("random")
    job = client.post(JOBS, json={"kind": "train"}).json()["id"]
    viewer = client_as("viewer")
    assert viewer.get(f"/api/v1/jobs/{job}").status_code == 200
    assert viewer.post(JOBS, json={"kind": "train"}).status_code == 403
    assert viewer.post(f"/api/v1/jobs/{job}/cancel").status_code == 403


def test_a_waiting_job_is_cancelled_at_once_followed_to_its_end_and_repeated(client: TestClient, upload: Upload) -> None:
    upload("random")
    job = client.post(JOBS, json={"kind": "train", "count": 2}).json()["id"]
    assert client.post(f"/api/v1/jobs/{job}/retry").status_code == 409
    assert client.post(f"/api/v1/jobs/{job}/cancel").json()["status"] == "cancelled"
    assert client.post(f"/api/v1/jobs/{job}/cancel").status_code == 409
    answer = client.get(f"/api/v1/jobs/{job}/events")
    assert answer.headers["content-type"].startswith("text/event-stream")
    kinds = [line.removeprefix("event: ") for line in answer.text.splitlines() if line.startswith("event: ")]
    assert kinds == ["job", "status", "cancel", "status", "end"]
    ids = [line.removeprefix("id: ") for line in answer.text.splitlines() if line.startswith("id: ")]
    rest = client.get(f"/api/v1/jobs/{job}/events", headers={"Last-Event-ID": ids[0]})
    assert [line.removeprefix("id: ") for line in rest.text.splitlines() if line.startswith("id: ")] == ids[1:]
    again = client.post(f"/api/v1/jobs/{job}/retry")
    assert again.status_code == 202
    assert again.json()["id"] != job
    assert again.json()["params"]["count"] == 2
    twice = client.post(f"/api/v1/jobs/{job}/retry")
    assert twice.status_code == 409
    assert again.json()["id"] in twice.json()["detail"]
    client.post(f"/api/v1/jobs/{again.json()['id']}/cancel")
    assert client.post(f"/api/v1/jobs/{job}/retry").status_code == 202


def test_a_job_that_does_not_exist_is_not_found(client: TestClient) -> None:
    for path in ("", "/events"):
        assert client.get(f"/api/v1/jobs/00000000-0000-0000-0000-000000000000{path}").status_code == 404


def test_the_jobs_page_starts_shows_and_cancels_a_job(client: TestClient, upload: Upload) -> None:
    upload("random")
    assert "Start a job" in client.get("/participants/P1/jobs").text
    page = client.post(
        "/participants/P1/jobs", data={"kind": "train", "preset": "quick", "count": "2", "updates": "", "seed": ""}, follow_redirects=True
    )
    assert "Job started." in page.text
    assert "/events" in page.text
    job = str(page.url.path).rsplit("/", 1)[1]
    assert client.get(f"/api/v1/jobs/{job}").json()["params"]["count"] == 2
    ended = client.post(f"/jobs/{job}/cancel", follow_redirects=True)
    assert "cancelled" in ended.text
    assert "Run again" in ended.text
    refused = client.post("/participants/P1/jobs", data={"kind": "train", "count": "many"})
    assert refused.status_code == 422
    assert "whole number" in refused.text


def test_the_form_runs_the_ticked_methods_and_else_those_of_the_answer(client: TestClient, upload: Upload) -> None:
    upload("random")

    def methods_of(**ticked: list[str]) -> list[str]:
        page = client.post("/participants/P1/jobs", data={"kind": "pipeline", "preset": "quick", **ticked}, follow_redirects=True)
        assert page.status_code == 200, page.text
        job = client.get(f"/api/v1/jobs/{str(page.url.path).rsplit('/', 1)[1]}").json()
        found: list[str] = job["params"]["methods"]
        return found

    assert methods_of(methods=["wis", "dual_dice"]) == ["wis", "dual_dice"]
    assert methods_of() == default_methods()
    refused = client.post("/participants/P1/jobs", data={"kind": "pipeline", "methods": ["wis", "aggregate"]})
    assert refused.status_code == 422
    assert "at least two other methods" in refused.text


def test_policies_of_another_window_are_left_out_or_refused_by_name_before_the_job_waits(
    client: TestClient, policies: list[int], db: Session
) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"window": 12}})
    answer = client.post("/api/v1/participants/P1/jobs", json={"kind": "evaluate", "policies": policies[:1]})
    assert answer.status_code == 422
    assert "windows of 10 beta amplitudes; the participant's settings say 12" in answer.text
    none = client.post("/api/v1/participants/P1/jobs", json={"kind": "evaluate"})
    assert none.status_code == 422
    assert "None of the 3 policies takes windows of 12" in none.text
    fitting = client.post("/api/v1/participants/P1/policies", data={"name": "wide"}, files={"file": ("w.onnx", constant_onnx(0.5, 12))})
    assert fitting.status_code == 201
    db.rollback()
    participant = participant_by_code(db, "P1", SYSTEM)
    assert [p.name for p in policies_to_rank(db, participant.id, EvaluateParams())] == ["wide"]
