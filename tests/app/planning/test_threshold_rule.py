"""The threshold rule of a policy from the form to the printed sheet, with a real job on real sessions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.learning.policies import proportional_onnx
from app.tables.audit import AuditEvent
from app.tables.jobs import Job
from ml.policies.policy import ProportionalPolicy
from tests.app.planning.serious_events import clear, event

PAGE = "/participants/P1/policies/{}/threshold-rule"
QUICK = {"preset": "quick", "device": "percept_pc", "min_ma": "0.5", "max_ma": "3"}


@pytest.fixture
def policy(client: TestClient, upload: Callable[..., int]) -> int:
    """A policy of P1 that follows beta, and eight sessions by four controllers."""
    for k, (controller, level) in enumerate(
        [("random", 1.0), ("cdbs", 1.0), ("random", 1.0), ("no_dbs", 0.0), ("random", 1.0), ("other", 0.6), ("random", 1.0), ("cdbs", 1.0)]
    ):
        upload(controller, level=level, steps=60 + k, qoc={"grasp_hz": 2 + 0.1 * k, "rating": 6 + k % 3, "tremor_percent": 5.0 * k})
    xi = client.get("/api/v1/participants/P1/settings").json()[-1]["xi_beta"]
    content = proportional_onnx(ProportionalPolicy(0.8 * xi, 1.2 * xi, 0.4), 10)
    added = client.post("/api/v1/participants/P1/policies", data={"name": "follows"}, files={"file": ("p.onnx", content)})
    assert added.status_code == 201, added.text
    return int(added.json()["id"])


def find(client: TestClient, wait: Callable[..., dict[str, Any]], policy: int, **form: str) -> dict[str, Any]:
    answer = client.post(PAGE.format(policy), data=QUICK | form, follow_redirects=False)
    assert answer.status_code == 303, answer.text
    done = wait(answer.headers["location"].split("/")[2].split("?")[0], 120)
    assert done["status"] == "succeeded", done
    return done


@pytest.mark.usefixtures("worker")
def test_a_rule_is_found_shown_checked_and_printed(client: TestClient, db: Session, policy: int, request: pytest.FixtureRequest) -> None:
    api, page = f"/api/v1{PAGE.format(policy)}", PAGE.format(policy)
    assert client.get(api).status_code == 404
    assert "No rule was found for this policy yet" in client.get(page).text
    done = find(client, request.getfixturevalue("ended"), policy)
    sheet = client.get(api).json()
    rule = sheet["rule"]
    assert 0.5 <= rule["lower_ma"] <= rule["upper_ma"] <= 3.0 == sheet["cdbs_ma"]
    assert sheet["job_id"] == done["id"]
    assert sheet["to_policy"]["low"] <= sheet["to_policy"]["value"] <= sheet["to_policy"]["high"]
    assert sheet["to_policy"]["value"] == pytest.approx(sheet["return_rule"]["value"] - sheet["return_policy"]["value"])
    assert 0 <= sheet["energy_rule"] <= 1
    # beta of a table is no power of the device: no number may be typed in
    assert not sheet["thresholds_in_device_unit"]
    values = {s["name"]: s["value"] for s in sheet["settings"]}
    assert not any("(0 mA" in value for value in values.values()), "a slow ramp is no ramp of 0"
    assert values["upper_threshold"].startswith("set in clinic")
    assert any("must be set in clinic" in text for text in sheet["warnings"])
    assert values["upper_ma"] == f"{rule['upper_ma']:.1f}"
    assert values["paused_ma"] == "3"
    shown = client.get(page).text
    assert "set in clinic" in shown
    assert "never above cDBS" in shown or "Never above the cDBS amplitude" in shown
    if sheet["refused"] is None:
        printed = client.get(f"{page}.pdf")
        assert printed.content.startswith(b"%PDF-")
        assert printed.content.count(b"/Type /Page\n") == 1, "one page"
        assert client.get(f"{api}/sheet").headers["content-type"] == "application/pdf"
        assert db.scalar(select(AuditEvent.id).where(AuditEvent.action == "download", AuditEvent.entity_id == str(policy))) is not None
    job = db.get_one(Job, done["id"])
    assert job.result is not None
    as_percept = {
        "beta": job.result["beta"] | {"source": "percept_lfp", "unit": "device units"},
        "verdict": {"code": "undecided", "within": None},
    }
    job.result = job.result | as_percept
    db.commit()
    sheet = client.get(api).json()
    assert sheet["thresholds_in_device_unit"]
    values = {s["name"]: (s["value"], s["unit"]) for s in sheet["settings"]}
    assert values["upper_threshold"][0].startswith(f"{rule['upper_threshold']:.3g}"[:3])
    assert "device units" in values["upper_threshold"][0]
    assert sheet["refused"] is None

    # what must keep a sheet from leaving
    fall = event(client, policy)
    assert client.get(f"{page}.pdf").status_code == 409
    assert "Nothing may be programmed" in client.get(page).text
    clear(client, fall)
    assert client.get(f"{page}.pdf").status_code == 200
    job.result = job.result | {"verdict": {"code": "unsafe", "within": 0.1}}
    db.commit()
    assert "unsafe" in client.get(f"{api}/sheet").json()["detail"]
    job.result = job.result | as_percept
    db.commit()
    lower = client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 2.5}, "reason": "retitrated"})
    assert lower.status_code == 200, lower.text
    assert "2.5 mA now" in client.get(f"{api}/sheet").json()["detail"]


def test_limits_above_cdbs_below_the_bounds_or_without_a_step_are_refused_at_their_field(client: TestClient, policy: int) -> None:
    page, jobs = PAGE.format(policy), "/api/v1/participants/P1/jobs"
    for form, words in (
        ({"max_ma": "3.1"}, "above the cDBS amplitude of 3 mA"),
        ({"min_ma": "1.9", "max_ma": "1.8"}, "Exchange them"),
        ({"min_ma": "1.81", "max_ma": "1.89"}, "multiple of the device"),
        ({"min_ma": "a lot"}, "a lot"),
    ):
        answer = client.post(page, data=QUICK | form)
        assert answer.status_code == 422, form
        assert words in answer.text.replace("&#39;", "'"), form
    above = client.post(jobs, json={"kind": "threshold_rule", "policy_id": policy, "max_ma": 3.1})
    assert above.status_code == 422
    assert client.post(jobs, json={"kind": "threshold_rule", "policy_id": 9999}).status_code == 404
    assert client.post(jobs, json={"kind": "threshold_rule"}).status_code == 422


def test_the_form_of_all_kinds_does_not_offer_what_needs_a_policy(client: TestClient, policy: int) -> None:
    offered = client.get("/participants/P1/jobs").text
    assert '<option value="evaluate"' in offered
    assert 'value="threshold_rule"' not in offered
    assert "Threshold rule" in client.get(f"/participants/P1/policies/{policy}").text
