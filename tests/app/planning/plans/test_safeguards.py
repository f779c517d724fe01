"""Verdicts and plans: unsafe policies need a clinician's reason, tests with care their lowest amplitude, and one of them a visit."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from tests.app.evaluations import judge as judge
from tests.app.evaluations import judged
from tests.app.evaluations import policies as policies
from tests.app.planning.serious_events import clear, event
from tests.ml.ope.posterior.draws import N

Judge = Callable[..., int]
Approve = Callable[..., Any]
UNSAFE = {"behaviour": {"below_cdbs_20_percent": 0.42}}
CAREFUL: dict[str, Any] = {"supported": False, "support": {"lowest_supported": 0.5, "dose": 0.4}}


@pytest.fixture
def visit(client: TestClient, policies: list[int]) -> int:
    """An open visit of P1."""
    return int(client.post("/api/v1/participants/P1/visits", json={"number": 2}).json()["id"])


def draft(client: TestClient, visit: int, *chosen: int, **more: Any) -> Any:
    return client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": list(chosen), "seed": 1, **more})


@pytest.mark.hazard("H04")
def test_an_unsafe_policy_is_planned_only_with_a_clinicians_reason(
    client: TestClient, client_as: Callable[..., TestClient], policies: list[int], judge: Judge, visit: int, sign_plan: Approve
) -> None:
    a, b, _ = policies
    judge({a: judged(50.0), b: judged(60.0, **UNSAFE)})
    refused = draft(client, visit, a, b)
    assert (refused.status_code, "nearly off 42 % of the time" in refused.json()["detail"]) == (422, True)
    override = [{"policy_id": b, "reason": "asked for by the family, 5 minutes, watched"}]
    assert draft(client_as("engineer"), visit, a, b, overrides=override).status_code == 403
    plan = draft(client, visit, a, b, overrides=override)
    assert plan.status_code == 201
    stated = {s["policy_id"]: (s["verdict"], s["override_reason"]) for s in plan.json()["sessions"] if s["policy_id"]}
    assert stated == {a: ("test", None), b: ("unsafe", "asked for by the family, 5 minutes, watched")}
    assert any("unsafe and planned all the same: asked for by the family" in w["text"] for w in plan.json()["warnings"])
    assert sign_plan(visit).status_code == 200


@pytest.mark.hazard("H24")
@pytest.mark.parametrize("ranked", [False, True])
def test_a_serious_adverse_event_needs_the_reason_whether_or_not_a_ranking_holds_its_policy(
    client: TestClient, policies: list[int], judge: Judge, visit: int, sign_plan: Approve, ranked: bool
) -> None:
    a, b, _ = policies
    if ranked:
        judge({b: judged(40.0)})
    assert draft(client, visit, a).status_code == 201
    found = event(client, a)
    unsigned = sign_plan(visit)
    assert (unsigned.status_code, "serious adverse event, not cleared" in unsigned.json()["detail"]) == (409, True)
    refused = draft(client, visit, a)
    assert (refused.status_code, "serious adverse event, not cleared" in refused.json()["detail"]) == (422, True)
    page = client.get(f"/visits/{visit}/plan").text
    assert f'name="override_{a}"' in page
    assert f'name="override_{b}"' not in page
    plan = draft(client, visit, a, overrides=[{"policy_id": a, "reason": "the fall was a stumble, watched"}])
    assert [(s["verdict"], s["override_reason"]) for s in plan.json()["sessions"] if s["policy_id"]] == [
        ("unsafe", "the fall was a stumble, watched")
    ]
    assert sign_plan(visit).status_code == 200
    cleared = client.post(f"/api/v1/adverse-events/{found['id']}/clearance", json={"revision": 1, "reason": "she tripped"})
    assert cleared.status_code == 200
    anew = draft(client, visit, a, reason="without the override").json()
    assert [(s["verdict"], s["override_reason"]) for s in anew["sessions"] if s["policy_id"]] == [(None, None)]


def test_what_is_dangerous_whatever_the_data_say_needs_the_reason_even_where_nothing_can_be_told(
    client: TestClient, policies: list[int], judge: Judge, visit: int
) -> None:
    judge({policies[0]: judged(50.0, told=False, **UNSAFE), policies[1]: judged(50.0, told=False)})
    assert draft(client, visit, policies[0]).status_code == 422
    assert draft(client, visit, policies[1]).status_code == 201, "what cannot be told may be tested: that is how it gets told"


def test_one_test_with_care_a_visit_and_its_lowest_amplitude_stands_in_the_plan(
    client: TestClient, policies: list[int], judge: Judge, visit: int, sign_plan: Approve
) -> None:
    a, b, c = policies
    judge({a: judged(50.0, **CAREFUL), b: judged(60.0, **CAREFUL), c: judged(40.0)})
    two = draft(client, visit, a, b)
    assert (two.status_code, "a visit takes one of them" in two.json()["detail"]) == (422, True)
    low = draft(client, visit, a, c, limits=[{"policy_id": a, "min_fraction": 0.3}])
    assert (low.status_code, "not to 0.30" in low.json()["detail"]) == (422, True)
    plan = draft(client, visit, a, c).json()
    assert {s["policy_id"]: s["min_fraction"] for s in plan["sessions"] if s["policy_id"]} == {a: 0.5, c: None}
    assert ("lowest_amplitude", "Policy 'p0' may not go below 1.5 mA.") in [(w["code"], w["text"]) for w in plan["warnings"]]
    higher = draft(client, visit, a, limits=[{"policy_id": a, "min_fraction": 0.7}]).json()
    assert [s["min_fraction"] for s in higher["sessions"] if s["policy_id"]] == [0.7]
    assert sign_plan(visit).status_code == 200


def test_no_plan_with_a_test_with_care_is_approved_without_its_limit(
    client: TestClient, policies: list[int], judge: Judge, visit: int, db: Session, sign_plan: Approve
) -> None:
    judge({policies[0]: judged(50.0, **CAREFUL)})
    assert draft(client, visit, policies[0]).status_code == 201
    db.execute(text("update plan_item set min_fraction = null"))
    db.commit()
    answer = sign_plan(visit)
    assert (answer.status_code, "states no lowest amplitude of at least 0.50" in answer.json()["detail"]) == (409, True)
    db.execute(text("update plan_item set min_fraction = 0.4 where policy_id is not null"))
    db.commit()
    assert sign_plan(visit).status_code == 409


def test_verdicts_are_asked_again_at_approval(
    client: TestClient, policies: list[int], judge: Judge, visit: int, sign_plan: Approve
) -> None:
    judge({policies[0]: judged(50.0, outcome_draws={"tremor_percent": [26.0] * N})})
    assert draft(client, visit, policies[0]).status_code == 201
    client.put("/api/v1/participants/P1/margins", json={"margins": {"tremor_points": 5}, "reason": "she fears tremor most"})
    answer = sign_plan(visit)
    assert (answer.status_code, "is worse by more than its margin, most often tremor" in answer.json()["detail"]) == (409, True)


@pytest.mark.parametrize("under", ["teacher", "student"])
def test_a_serious_adverse_event_holds_back_what_does_the_same_by_making(
    client: TestClient, policies: list[int], judge: Judge, visit: int, db: Session, under: str
) -> None:
    teacher, student, other = policies
    judge({i: judged(50.0) for i in policies})
    made = "snapshot_id = (select max(id) from buffer_snapshot)"
    db.execute(text(f"update policy set {made}, kind = 'trained' where id = :a"), {"a": teacher})
    db.execute(text(f"update policy set {made}, kind = 'distilled', teacher_id = :a where id = :b"), {"a": teacher, "b": student})
    db.commit()
    assert draft(client, visit, teacher, student, other).status_code == 201
    found = event(client, teacher if under == "teacher" else student)
    for policy in (teacher, student):
        refused = draft(client, visit, policy)
        assert (refused.status_code, "serious adverse event, not cleared" in refused.json()["detail"]) == (422, True), refused.text
    assert draft(client, visit, other).status_code == 201
    clear(client, found)
    assert draft(client, visit, teacher, student).status_code == 201


@pytest.mark.hazard("H04")
@pytest.mark.parametrize("newest_is_strict", [True, False])
def test_a_plan_on_an_older_ranking_goes_by_the_newest_too(
    client: TestClient, policies: list[int], judge: Judge, visit: int, sign_plan: Approve, newest_is_strict: bool
) -> None:
    a, b, c = policies
    lenient = {i: judged(50.0) for i in policies}
    strict = {a: judged(50.0, **UNSAFE), b: judged(60.0, **CAREFUL), c: judged(40.0, **CAREFUL)}
    older, _ = [judge(found) for found in ([lenient, strict] if newest_is_strict else [strict, lenient])]
    refused = draft(client, visit, a, evaluation_id=older)
    assert (refused.status_code, "nearly off 42 % of the time" in refused.json()["detail"]) == (422, True)
    two = draft(client, visit, b, c, evaluation_id=older)
    assert (two.status_code, "a visit takes one of them" in two.json()["detail"]) == (422, True)
    low = draft(client, visit, b, evaluation_id=older, limits=[{"policy_id": b, "min_fraction": 0.3}])
    assert (low.status_code, "not to 0.30" in low.json()["detail"]) == (422, True)
    plan = draft(client, visit, a, b, evaluation_id=older, overrides=[{"policy_id": a, "reason": "watched"}]).json()
    stated = {s["policy_id"]: (s["verdict"], s["min_fraction"], s["override_reason"]) for s in plan["sessions"] if s["policy_id"]}
    assert stated == {a: ("unsafe", None, "watched"), b: ("test_with_care", 0.5, None)}
    assert plan["evaluation"]["id"] == older
    assert sign_plan(visit).status_code == 200


def test_a_limit_is_the_higher_of_both_rankings(client: TestClient, policies: list[int], judge: Judge, visit: int) -> None:
    a = policies[0]
    limited = [judged(50.0, supported=False, support={"lowest_supported": least, "dose": 0.4}) for least in (0.7, 0.5)]
    older, _ = [judge({a: found}) for found in limited]
    for chosen, least in ((None, 0.5), (older, 0.7)):
        plan = draft(client, visit, a, evaluation_id=chosen).json()
        assert [s["min_fraction"] for s in plan["sessions"] if s["policy_id"]] == [least]


def test_a_ranking_that_is_made_after_the_draft_counts_at_the_signature(
    client: TestClient, policies: list[int], judge: Judge, visit: int, sign_plan: Approve
) -> None:
    a, b, _ = policies
    judge({a: judged(50.0)})
    assert draft(client, visit, a).status_code == 201
    judge({a: judged(50.0, **CAREFUL), b: judged(40.0)})
    careful = sign_plan(visit)
    assert (careful.status_code, "states no lowest amplitude of at least 0.50" in careful.json()["detail"]) == (409, True)
    judge({a: judged(50.0, **UNSAFE), b: judged(40.0)})
    unsafe = sign_plan(visit)
    assert (unsafe.status_code, "nearly off 42 % of the time" in unsafe.json()["detail"]) == (409, True)
    judge({a: judged(50.0), b: judged(40.0)})
    assert sign_plan(visit).status_code == 200


@pytest.mark.hazard("H04")
def test_a_reference_is_planned_by_the_same_rule_as_a_candidate(
    client: TestClient, policies: list[int], judge: Judge, visit: int, db: Session, sign_plan: Approve
) -> None:
    a = policies[0]
    judge({a: judged(50.0)})
    baselines = {row.name: row.id for row in db.execute(text("select id, name from policy where kind = 'baseline'"))}
    cdbs = baselines.pop("cDBS (constant 1.00)")
    assert {"constant 0.40", "constant 0.55"} < set(baselines), "and two that follow beta"
    judge({a: judged(50.0)} | {i: judged(10.0, **UNSAFE) for i in baselines.values()})
    for name, i in baselines.items():
        refused = draft(client, visit, i)
        assert (refused.status_code, "nearly off 42 % of the time" in refused.json()["detail"]) == (422, True), name
    held = baselines["constant 0.40"]
    plan = draft(client, visit, held, overrides=[{"policy_id": held, "reason": "watched"}]).json()
    assert {(s["verdict"], s["override_reason"]) for s in plan["sessions"] if s["policy_id"]} == {("unsafe", "watched")}
    assert sign_plan(visit).status_code == 200
    judge({a: judged(50.0, **CAREFUL), held: judged(10.0, **CAREFUL)})
    assert "a visit takes one of them" in draft(client, visit, a, held, reason="anew").json()["detail"]
    careful = draft(client, visit, held, reason="anew").json()
    assert {(s["verdict"], s["min_fraction"]) for s in careful["sessions"] if s["policy_id"]} == {("test_with_care", 0.5)}
    assert draft(client, visit, cdbs).json()["sessions"][0]["verdict"] is None, "cDBS is what everything is held against"
    shown = client.get("/api/v1/participants/P1/ranking").json()
    assert {r["decision"] for r in shown["references"]} == {None}, "the ranking itself judges candidates alone"


def test_a_reason_for_what_is_not_unsafe_is_not_kept_and_one_for_what_is_not_planned_is_refused(
    client: TestClient, policies: list[int], judge: Judge, visit: int
) -> None:
    a, b, _ = policies
    judge({a: judged(50.0), b: judged(50.0)})
    plan = draft(client, visit, a, overrides=[{"policy_id": a, "reason": "why not"}]).json()
    assert [s["override_reason"] for s in plan["sessions"]] == [None] * len(plan["sessions"])
    stray = draft(client, visit, a, limits=[{"policy_id": b, "min_fraction": 0.5}])
    assert (stray.status_code, f"Policy {b} has a reason or a limit" in stray.json()["detail"]) == (422, True)


def test_the_form_asks_for_the_reason_and_the_limit_and_keeps_what_was_typed(
    client: TestClient, policies: list[int], judge: Judge, visit: int
) -> None:
    a, b, _ = policies
    judge({a: judged(50.0, **UNSAFE), b: judged(60.0, **CAREFUL)})
    page, path = client.get(f"/visits/{visit}/plan").text, f"/visits/{visit}/plan"
    assert f'name="override_{a}"' in page
    assert f'name="limit_{b}"' in page
    assert 'value="0.5000"' in page
    headers = {"Sec-Fetch-Site": "same-origin"}
    low = client.post(path, data={"policy_ids": [a, b], f"override_{a}": "watched", f"limit_{b}": "0.2"}, headers=headers)
    assert low.status_code == 422
    assert 'value="watched"' in low.text
    assert 'value="0.2"' in low.text
    wrong = client.post(path, data={"policy_ids": [b], f"limit_{b}": "low"}, headers=headers)
    assert (wrong.status_code, "is no number" in wrong.text) == (422, True)
    done = client.post(
        path, data={"policy_ids": [a, b], f"override_{a}": "watched", f"limit_{b}": "0.6"}, headers=headers, follow_redirects=False
    )
    assert done.status_code == 303
    plan = client.get(f"/api/v1{path}").json()
    stated = {s["policy_id"]: (s["min_fraction"], s["override_reason"]) for s in plan["sessions"] if s["policy_id"]}
    assert stated == {a: (None, "watched"), b: (0.6, None)}


@pytest.mark.hazard("H04")
def test_a_bundle_of_a_policy_tested_with_care_does_not_go_below_the_approved_limit(
    client: TestClient, policies: list[int], judge: Judge, visit: int, sign_plan: Approve
) -> None:
    bundle = f"/api/v1/policies/{policies[0]}/bundle"
    judge({policies[0]: judged(50.0, **CAREFUL)})
    assert draft(client, visit, policies[0]).status_code == 201
    assert lowest_ma(client.get(bundle).content) == 0.0, "a draft limits nothing"
    assert sign_plan(visit).status_code == 200
    assert lowest_ma(client.get(bundle).content) == 1.5
    below = client.get(bundle, params={"min_ma": 1.2})
    assert (below.status_code, "below the 1.5 mA" in below.json()["detail"]) == (422, True)
    assert lowest_ma(client.get(bundle, params={"min_ma": 2.0}).content) == 2.0


def lowest_ma(content: bytes) -> float:
    """Return the lower limit that a bundle states, mA."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith("manifest.json")]
        return float(json.loads(archive.read(name))["min_ma"])
