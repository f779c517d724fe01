"""All participants together: the summary, the figure, the tables."""

from __future__ import annotations

import csv
import html
import io
import itertools
import json
import math
import re
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.analysis import pooled
from app.analysis.pooled import Pooled, PooledController, PooledMetric, TrialTime
from app.analysis.pooled import _outline as outline
from app.analysis.pooled_web import pooled_out
from app.platform import kept
from app.tables.sessions import Controller
from ml.statistics.within_visits.contrasts import Reason, Unavailable
from tests.app.analysis.conftest import adder


@pytest.fixture
def four(client: TestClient, db: Session, participant_code: str) -> dict[str, float]:
    """Participants P1 to P4 of three visits each; RL lowers the energy by a known share and is a little faster in grasps."""
    saved = {"P1": 0.5, "P2": 0.4, "P3": 0.6, "P4": 0.3}
    for code, share in saved.items():
        if code != participant_code:
            assert client.post("/api/v1/participants", json={"code": code, "settings": {"cdbs_amplitude_ma": 3.0}}).status_code == 201
        add = adder(db, code)
        for visit in (1, 2, 3):
            for k in range(4):
                rl = k % 2 == 1
                fraction = (1 - share) ** 0.5 * (1 + 0.01 * visit) if rl else 1.0
                add("rl" if rl else "cdbs", fraction=fraction, grasp=2 + 0.1 * visit + 0.05 * rl * k, rating=7, visit=visit)
    return saved


def test_every_participant_and_all_together_with_no_claim_about_others(client: TestClient, four: dict[str, float]) -> None:
    answer = client.get("/api/v1/analyses").json()
    energy = next(m for m in answer["metrics"] if m["metric"] == "energy")
    own = {e["participant"]: e["result"]["estimate"] for e in energy["each"]}
    # RL has (1 - share) times the mean of 1.01^2, 1.02^2, 1.03^2, cDBS has 1
    drift = (1.01**2 + 1.02**2 + 1.03**2) / 3
    assert own == pytest.approx({code: (1 - share) * drift - 1 for code, share in four.items()}, abs=1e-5)
    together = energy["together"]
    assert min(own.values()) < together["estimate"] < max(own.values())
    assert together["smallest_sign_p"] == 0.125
    assert "cannot go below .125" in together["text"]
    assert "claims nothing about other people" in client.get("/analyses").text


def test_the_page_is_reached_from_the_navigation_and_leads_to_each_participant(client: TestClient, four: dict[str, float]) -> None:
    assert '<a href="/analyses"' in client.get("/").text
    page = client.get("/analyses").text
    for code in four:
        assert f'href="/participants/{code}/analyses"' in page
        assert '<a href="/participants/P1/analyses" >Analyses</a>' in client.get("/participants/P1").text
    assert "Trial time" in page


def test_one_page_of_the_list_is_pooled_with_all_the_others(client: TestClient, four: dict[str, float]) -> None:
    whole, part = (client.get(f"/analyses{query}").text for query in ("", "?limit=2&offset=1"))
    assert "of all 4 participants" in part
    assert "of all 4 participants" not in whole
    assert [f"/participants/{code}/analyses/visits" in part for code in ("P1", "P2", "P3", "P4")] == [False, True, True, False]
    totals = r'<tr><th scope="row">All</th>.*?</tr>'
    together = "[^>]*claims nothing about other people[^<]*"
    for pattern in (totals, together):
        (mine,), (all_of_them,) = (set(re.findall(pattern, text, re.DOTALL)) for text in (part, whole))
        assert mine == all_of_them
    source = re.findall(r'data-src="([^"]+)"', part)[0]
    data = client.get(html.unescape(source)).json()["data"]
    assert sum(len(t["y"]) for t in data if t["type"] == "scatter") == 2 * 12


def test_nothing_is_computed_again_of_participants_whom_nothing_changed(
    client: TestClient, four: dict[str, float], statements: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept, "KEPT", 3)  # a study larger than what is kept whole
    client.get("/api/v1/analyses")
    statements.clear()
    client.get("/api/v1/analyses")
    assert not any("trace.values_f32" in s for s in statements)
    assert client.patch("/api/v1/sessions/13", json={"excluded_reason": "tablet froze"}).status_code == 200, "P2's first"
    read: list[str] = []
    monkeypatch.setattr(pooled, "_outline", lambda key, held, of: read.append(held.participant) or outline(key, held, of))
    client.get("/api/v1/analyses")
    assert read == ["P2"]


def test_the_charts_of_many_sessions_come_by_themselves_and_not_with_the_page(client: TestClient, four: dict[str, float]) -> None:
    page = client.get("/analyses").text
    sources = re.findall(r'<script type="application/json" data-src="([^"]+)"></script>', page)
    assert len(sources) == 4, "energy, beta, grasp and rating were measured"
    assert '"customdata"' not in page
    for source in sources:
        data = client.get(source).json()["data"]
        assert sum(len(t["y"]) for t in data if t["type"] == "scatter") == 4 * 12
    assert client.get("/analyses/figure?metric=height").status_code == 404


def test_the_figure_is_an_svg_with_every_session(client: TestClient, four: dict[str, float]) -> None:
    for path in ("/analyses/results.svg", "/api/v1/analyses?format=svg", "/participants/P1/analyses/paper.svg"):
        answer = client.get(path)
        assert answer.headers["content-type"].startswith("image/svg+xml")
        root = ElementTree.fromstring(answer.text)
        points = root.findall(".//{http://www.w3.org/2000/svg}circle")
        participants = 1 if "P1" in path else 4
        assert len(points) == participants * 12 * 4  # four metrics were measured: energy, beta, grasp and rating


def test_sessions_with_equal_values_are_as_many_dots(client: TestClient, add_session: Callable[..., int]) -> None:
    for _ in range(6):
        add_session("cdbs", fraction=1.0, grasp=2.0, rating=7)
    root = ElementTree.fromstring(client.get("/participants/P1/analyses/paper.svg").text)
    points = [(float(c.get("cx", "")), float(c.get("cy", ""))) for c in root.iter("{http://www.w3.org/2000/svg}circle")]
    assert len(points) >= 18
    assert min(math.dist(a, b) for a, b in itertools.combinations(points, 2)) >= 4.0, "px; a dot is 4.8 wide"
    charts = json.loads(client.get("/analyses/figure?metric=rating").text)
    dots = next(t for t in charts["data"] if t["type"] == "scatter")
    assert len(set(dots["x"])) == 6
    assert client.get("/participants/P1/analyses/paper").text.count("% of cDBS") >= 2, "energy is told as on every page"


def test_the_table_has_every_comparison(client: TestClient, four: dict[str, float]) -> None:
    rows = list(csv.DictReader(io.StringIO(client.get("/analyses/results.csv").text)))
    assert {(r["participant"], r["controller"]) for r in rows} == {(p, c) for p in four for c in ("cdbs", "rl")}
    energy = next(r for r in rows if (r["participant"], r["metric"], r["controller"]) == ("P1", "energy", "rl"))
    assert float(energy["p"]) == pytest.approx(2 / 924)  # 6 against 6, all apart


def test_an_asterisk_stands_only_in_the_desired_direction(client: TestClient, add_session: Callable[..., int]) -> None:
    for i in range(5):
        add_session("cdbs", fraction=1.0 - 0.001 * i, grasp=2 + 0.01 * i, tremor=5 + i)
        add_session("no_dbs", fraction=0.0)  # saves by definition
        add_session("rl", fraction=0.7 + 0.001 * i, grasp=1 + 0.01 * i, tremor=50 + i)  # saves energy, and is worse in everything else
    charts = client.get("/participants/P1/analyses/paper").text
    assert charts.count("*") - charts.count("/*") >= 1
    svg = ElementTree.fromstring(client.get("/participants/P1/analyses/paper.svg").text)
    labels = [t.text or "" for t in svg.iter("{http://www.w3.org/2000/svg}text")]
    assert [t for t in labels if t.endswith(" *")] == [".008 *"]
    assert labels.count(".008") == 3


def test_computation_time_counts_ended_steps(client: TestClient, db: Session, participant_code: str) -> None:
    from datetime import UTC, datetime, timedelta

    from app.accounts.permissions import SYSTEM
    from app.study import repository
    from app.tables.jobs import Job, JobStatus, JobStep

    participant = repository.participant_by_code(db, participant_code, SYSTEM)
    start = datetime(2026, 3, 2, tzinfo=UTC)
    fields: dict[str, Any] = {"params": {}, "code_version": "x", "created_by": "test", "kind": "train", "participant_id": participant.id}
    db.add(Job(id="j", status=JobStatus.SUCCEEDED, finished_at=start, **fields))
    db.flush()
    for k, seconds in enumerate((10, 30, 50)):
        end = start + timedelta(seconds=seconds)
        step = {"title": "t", "position": k, "status": JobStatus.SUCCEEDED, "started_at": start, "finished_at": end}
        db.add(JobStep(job_id="j", key=f"train/{k}", **step))
    db.commit()
    (row,) = client.get("/api/v1/analyses").json()["computation_time"]
    assert row == {"job": "train", "step": "train", "n": 3, "median_s": 30.0, "longest_s": 50.0}
    shown = client.get("/analyses").text
    assert "Computation time" in shown
    for table in ("computation_time", "trial_time"):
        address = f"/api/v1/analyses?format=csv&table={table}"
        assert html.escape(address) in shown
        rows = list(csv.DictReader(io.StringIO(client.get(address).text)))
        assert [list(r.values()) for r in rows] == [[str(v) for v in r.values()] for r in client.get("/api/v1/analyses").json()[table]]
    assert client.get("/api/v1/analyses?format=csv&table=weather").status_code == 422


def test_without_anything_the_pages_say_so(client: TestClient) -> None:
    for path in ("/analyses", "/api/v1/analyses", "/analyses/results.csv", "/analyses/results.svg", "/trial-time", "/analyses/figure"):
        assert client.get(path).status_code == 200, path


def test_beta_that_is_not_pooled_has_the_same_reason_on_the_page_and_over_rest() -> None:
    beta = PooledMetric("mean_beta", (), Unavailable(Reason.NOT_IDENTIFIED))
    answer = pooled_out(Pooled((), (PooledController(Controller.RL, (beta,)),), TrialTime([], [], [], [], 0)), [])
    assert answer.metrics[0].together.text == "Beta of different unit or source is not pooled."
