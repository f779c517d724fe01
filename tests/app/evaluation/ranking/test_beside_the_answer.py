"""Additions to the answer of the ranking: the best fixed amplitude, and sessions near an amplitude where no policy is worth a test."""

from __future__ import annotations

import re
from collections.abc import Callable

from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.tables.learning import Policy
from tests.app.evaluations import judged
from tests.app.words import above_fold
from tests.ml.ope.posterior.draws import N, cdbs

PAGE = "/participants/P1/ranking"
Judge = Callable[..., int]


def test_the_best_fixed_amplitude_stands_beside_the_answer_where_it_is_not_that_of_cdbs(
    client: TestClient, policies: list[int], judge: Judge, db: Session
) -> None:
    judge({policies[0]: judged(50.0)})
    assert "For comparison" not in above_fold(client.get(PAGE).text), "no other amplitude was evaluated"
    constants = db.scalars(select(Policy).where(Policy.kind == "baseline", Policy.algorithm == "constant").order_by(Policy.id)).all()
    low = next(p for p in constants if p.config["amplitude"] < 1)
    drawn = {"energy": [0.5] * N, "grasp_hz": [1.7] * 250 + [1.9] * 750}
    judge({policies[0]: judged(50.0), low.id: judged(60.0, outcome_draws=drawn)})
    assert (
        "For comparison, 2.55 mA all the time, the best fixed amplitude by the same scores: energy "
        "\N{MINUS SIGN}50 %, grasp \N{MINUS SIGN}0.2 Hz, rating unchanged, tremor unchanged; 75 % chance that grasp, rating "
        "and tremor all stay within the margins."
    ) in above_fold(client.get(PAGE).text)
    judge({policies[0]: judged(50.0), low.id: judged(-60.0, outcome_draws=drawn)})
    assert "For comparison" not in above_fold(client.get(PAGE).text), "cDBS is the best fixed amplitude"


def test_the_best_fixed_amplitude_is_a_row_that_can_be_ticked_and_planned(
    client: TestClient, policies: list[int], judge: Judge, db: Session
) -> None:
    judge({policies[0]: judged(50.0)})
    constants = db.scalars(select(Policy).where(Policy.kind == "baseline", Policy.algorithm == "constant").order_by(Policy.id)).all()
    low = next(p for p in constants if p.config["amplitude"] < 1)
    judge({policies[0]: judged(50.0), low.id: judged(60.0)})
    last = client.get(PAGE).text.split('id="candidates"')[1].split("</table>")[0].split("For comparison:")[1]
    assert "2.55 mA all the time" in " ".join(last.split())
    assert f'name="policy_ids" value="{low.id}"' in last
    sent = {"policy_ids": str(low.id), "visit_number": "7", "visit_date": "2031-01-07", "random_sessions": "0"}
    planned = client.post("/participants/P1/plan/draft", data=sent, follow_redirects=False)
    assert planned.status_code == 303, planned.text
    visit = int(planned.headers["location"].split("/")[2])
    assert low.id in [s["policy_id"] for s in client.get(f"/api/v1/visits/{visit}/plan").json()["sessions"]]
    judge({policies[0]: judged(50.0), low.id: judged(60.0, outcome_draws={"tremor_percent": [45.0] * N})})
    last = client.get(PAGE).text.split("For comparison:")[1]
    assert f'name="policy_ids" value="{low.id}"' not in last, "one that is unsafe is planned with a reason alone"


def test_where_nothing_is_worth_a_test_random_and_cdbs_sessions_are_planned_at_a_click(
    client: TestClient, policies: list[int], judge: Judge
) -> None:
    judge({policies[0]: judged(50.0, told=False, behaviour={"below_cdbs_20_percent": 0.9})}, cdbs(told=False).to_json())
    page = client.get(PAGE).text
    form = re.search(r'<form method="post" action="([^"]+/plan/draft)"(?:(?!</form>).)*Draft the suggested visit', page, re.S)
    assert form is not None
    sent = dict(re.findall(r'name="(\w+)"\s+value="([\d.]+)"', form[0])) | {"visit_number": "7", "visit_date": "2031-01-07"}
    planned = client.post(form[1], data=sent, follow_redirects=False)
    assert planned.status_code == 303, planned.text
    visit = int(planned.headers["location"].split("/")[2])
    sessions = client.get(f"/api/v1/visits/{visit}/plan").json()["sessions"]
    assert sorted({s["controller"] for s in sessions}) == ["cdbs", "random"]


def test_a_first_answer_tells_of_fixed_amplitudes_until_the_policies_of_its_job_are_there(
    client: TestClient, policies: list[int], judge: Judge, db: Session
) -> None:
    job = client.post("/api/v1/participants/P1/jobs", json={"kind": "pipeline", "preset": "quick"}).json()["id"]
    judge({policies[0]: judged(50.0)})
    low = db.scalars(select(Policy).where(Policy.algorithm == "constant").order_by(Policy.id.desc())).first()
    assert low is not None
    first = judge({low.id: judged(60.0)}, candidates=[], job_id=job, first_answer=True)
    assert judge({low.id: judged(60.0)}, candidates=[], job_id=job, first_answer=True) == first, "stored once"
    ranking = client.get("/api/v1/participants/P1/ranking").json()
    assert (ranking["first_answer"], ranking["job_id"], ranking["policies"]) == (True, job, [])
    assert {r["policy_id"] for r in ranking["references"]} >= {low.id}
    page = client.get(PAGE).text
    text = above_fold(page)
    assert "First answer, until the new policies are trained" in text
    assert "This ranking has fixed amplitudes alone: no policy could be ranked when it was made." in text
    assert "For comparison, 1.2 mA all the time, the best fixed amplitude" in text
    assert "no policy is barred" not in text, "there is none"
    assert "No candidate yet." in text
    assert 'id="ranking" class="stack" data-refresh=' in page, "the ranking follows by itself"
    last = judge({policies[0]: judged(50.0)}, job_id=job)
    assert last != first
    ranking = client.get("/api/v1/participants/P1/ranking").json()
    assert (ranking["first_answer"], ranking["evaluation_id"]) == (False, last)
    assert "First answer" not in client.get(PAGE).text
