"""Beta as a biomarker, progression, and the course after a dose."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable

import numpy as np
import pytest
from fastapi.testclient import TestClient

from app.analysis.biomarker import Pairing
from app.analysis.biomarker_web import scatter
from ml.statistics.within_visits.contrasts import Reason, Unavailable

PATH = "/api/v1/participants/P1/analyses/beta"


@pytest.fixture
def days(add_session: Callable[..., int]) -> None:
    """Within a visit more beta goes with more tremor; between visits it goes with less."""
    for visit in range(1, 6):
        for k in range(4):
            add_session(
                "cdbs",
                beta=visit + 0.1 * k,
                tremor=60 - 10 * visit + 5 * k + (k % 2) + 0.3 * visit * (k == 3),
                grasp=3 - 0.1 * visit,
                visit=visit,
                medication_h=0.5 * k,
            )


def test_within_and_between_visits_are_kept_apart(client: TestClient, days: None) -> None:
    tremor = next(p for p in client.get(PATH).json()["beta"] if p["y"] == "tremor")
    assert tremor["within_visits"]["correlation"] > 0.9
    assert tremor["within_visits"]["low"] > 0
    assert tremor["between_visits"]["correlation"] < -0.9
    assert len(tremor["session_ids"]) == 20


def test_the_months_are_those_of_the_visits_under_cdbs_alone(client: TestClient, days: None, add_session: Callable[..., int]) -> None:
    add_session("rl", grasp=9.0, visit=5)
    grasp = next(p for p in client.get(PATH).json()["progression"] if p["y"] == "grasp")
    assert grasp["between_visits"]["slope"] == pytest.approx(-0.1 / (28 / 30.4375), rel=1e-3)
    assert len(grasp["session_ids"]) == 20


def test_what_a_dose_does_needs_its_time(client: TestClient, days: None) -> None:
    found = next(p for p in client.get(PATH).json()["medication"] if p["y"] == "tremor")
    assert found["within_visits"]["slope"] > 0
    assert "Slopes are per hour" in client.get("/participants/P1/analyses/beta").text


def test_too_little_is_said(client: TestClient, add_session: Callable[..., int]) -> None:
    add_session("cdbs")
    page = client.get("/participants/P1/analyses/beta")
    assert page.status_code == 200
    assert "are needed" in page.text
    assert "Nobody stated it" in page.text


def test_the_medication_of_a_session_is_entered_on_its_page(client: TestClient, add_session: Callable[..., int]) -> None:
    session = add_session("cdbs")
    form = {"medication_h": "1.5", "stopped_reason": "dyskinesia", "reason": "from the diary"}
    assert client.post(f"/sessions/{session}/correction", data=form, follow_redirects=False).status_code == 303
    stored = client.get(f"/api/v1/sessions/{session}").json()
    assert (stored["medication_h"], stored["stopped_reason"]) == (1.5, "dyskinesia")
    assert "dyskinesia" in client.get(f"/sessions/{session}").text
    assert client.patch(f"/api/v1/sessions/{session}", json={"medication_h": 500}).status_code == 422


def test_a_chart_of_a_long_study_stays_small_and_names_each_dot() -> None:
    rng = np.random.default_rng(0)
    points = tuple((i + 1, i // 9 + 1, float(x), float(y)) for i, (x, y) in enumerate(rng.normal(2, 0.5, (333, 2))))
    nothing = Unavailable(Reason.NOT_IDENTIFIED)
    trace = scatter(Pairing("mean_beta", "grasp", nothing, nothing, points), "uV").figure["data"][0]
    assert len(gzip.compress(json.dumps([trace["x"], trace["y"]]).encode())) < 4000
    assert trace["x"] == pytest.approx([p[2] for p in points], rel=1e-4)
    assert (trace["customdata"][32], trace["marker"]["color"][32]) == (33, 4)
