"""The default method is the one with the best held-out skill; a stated order decides where the data cannot."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation import wording
from app.evaluation.decision import gain_over
from app.evaluation.estimates.choice import choose, combined, difference_errors, no_difference_error, widened
from app.evaluation.models import Evaluation
from app.evaluation.service import store_evaluation
from app.learning.snapshots.service import take_snapshot
from app.study.repository import participant_by_code
from ml.ope.estimate import Estimate
from ml.ope.flags import Flag
from tests.app.evaluations import estimate

LEAST = Flag.of("difference_error", 0.2, 0.2, "share of range", method="fqe", controllers=4.0)


def words(found: dict[str, Any]) -> str:
    return wording.choice([Flag.from_json(reason) for reason in found["reasons"]])


def skill(method: str, error: float, bias: float = 1.0) -> dict[str, Any]:
    return {
        "method": method, "controllers": 4, "difference_error": error, "error": error, "bias": bias, "rank_correlation": 0.8,
        "pairs_in_order": 0.9,
    }  # fmt: skip


def outcome(method: str, *table: dict[str, Any], by_data: bool = True, reason: Flag = LEAST) -> dict[str, Any]:
    choice: dict[str, Any] = {
        "method": method,
        "chosen_by_data": by_data,
        "reasons": [reason.to_json()],
        "table": list(table),
        "predictions": [],
        "failed": {},
    }
    return {"choice": choice}


def seen(method: str, **observed: float) -> list[dict[str, Any]]:
    return [{"method": method, "controller": name, "observed": value} for name, value in observed.items()]


NO_SKILL = outcome("fqe", skill("fqe", 0.7), skill("linear", 0.9))
NO_SKILL["choice"]["predictions"] = seen("fqe", random=0.0, cdbs=4.0, no_dbs=10.0) + seen("linear", random=0.0, cdbs=4.0)


def tables(**supported: bool) -> dict[str, Any]:
    return {
        m: {"1": Estimate.from_json(estimate(m, 50.0, supported=s)), "2": Estimate.from_json(estimate(m, 60.0, supported=s))}
        for m, s in supported.items()
    }


def test_the_method_with_the_best_skill_is_the_default() -> None:
    found = choose(tables(dlsm=True, linear=True, fqe=True), outcome("fqe", skill("fqe", 0.1), skill("linear", 0.3)))
    assert (found["method"], found["chosen_by_data"], found["reasons"]) == ("fqe", True, [LEAST.to_json()])
    assert found["not_compared"] == ["dlsm"]


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (None, "No method was held against left-out controllers"),
        ({"failed": "too few sessions"}, "The data cannot choose: too few sessions"),
        (
            outcome("fqe", by_data=False, reason=Flag("too_few_controllers", 2.0, 3.0, "controllers")),
            "The data cannot choose: 2 controllers could be left out, 3 are needed. Taken",
        ),
        (outcome("wdr", skill("wdr", 0.1)), "Weighted doubly robust predicted left-out controllers best, but has no estimate"),
        (NO_SKILL, "No method predicted left-out controllers better than if it had said that all return the same"),
        (outcome("wis", skill("wis", 0.1)), "predicted left-out controllers best, but supports none of the candidates"),
    ],
    ids=["not run", "failed", "too few controllers", "no estimate", "no skill", "supports nothing"],
)
def test_where_the_data_cannot_choose_the_stated_order_does_and_says_so(given: dict[str, Any] | None, named: str) -> None:
    found = choose(tables(dlsm=True, linear=True, fqe=True, wis=False), given)
    assert (found["method"], found["chosen_by_data"]) == ("linear", False)
    assert named in words(found)
    assert "usual order" in words(found)


def test_where_the_best_method_supports_no_candidate_the_next_best_that_does_is_taken() -> None:
    skills = (skill("wis", 0.1), skill("fqe", 0.3), skill("linear", 0.4))
    found = choose(tables(dlsm=True, linear=True, fqe=True, wis=False), outcome("wis", *skills))
    assert (found["method"], found["chosen_by_data"]) == ("fqe", True)
    assert "Weighted importance sampling predicted left-out controllers best, but supports none" in words(found)
    assert "Fitted Q evaluation is the best of those that support a candidate" in words(found)


def test_the_error_without_skill_is_that_of_saying_that_all_controllers_are_alike() -> None:
    predictions = NO_SKILL["choice"]["predictions"]
    assert no_difference_error(predictions) == pytest.approx((4 + 10 + 6) / 3 / 10)
    assert no_difference_error(predictions[:1]) is None
    assert no_difference_error([]) is None
    better = outcome("fqe", skill("fqe", 0.6), skill("linear", 0.9))
    better["choice"]["predictions"] = predictions
    assert choose(tables(fqe=True, linear=True), better)["chosen_by_data"] is True
    # what is next in skill is not taken when it has none
    worse = outcome("fqe", skill("fqe", 0.6), skill("wdr", 0.9))
    worse["choice"]["predictions"] = predictions
    assert choose(tables(linear=True, fqe=False, wdr=True), worse)["method"] == "linear"


def test_only_methods_of_known_bias_are_combined() -> None:
    made = combined(tables(dlsm=True, linear=True, fqe=True), outcome("fqe", skill("fqe", 0.1), skill("linear", 0.3, bias=9.0)))
    weights = made["estimates"]["1"].details["weights"]
    assert set(weights) == {"fqe", "linear"}
    assert weights["fqe"] > 0.9  # its squared error is some hundredth of the other's
    assert "at least two methods" in combined(tables(dlsm=True, fqe=True), outcome("fqe", skill("fqe", 0.1)))["failed"]
    assert "supports any policy" in combined(tables(dlsm=False, fqe=False), None)["failed"]


def test_intervals_are_widened_by_the_errors_on_left_out_controllers() -> None:
    given = outcome("fqe", skill("fqe", 0.1) | {"excess": 10.0}, skill("linear", 0.2) | {"excess": 0.0})
    given["choice"]["predictions"] = [
        {"method": m, "controller": name, "predicted": said, "observed": seen, "observed_standard_error": error, "supported": supported}
        for m, rows in {
            # fqe: differences of supported controllers off by 5 with a noise of 3 and 0; the third controller was not supported
            "fqe": (("random", 10.0, 10.0, 3.0, True), ("cdbs", 25.0, 20.0, None, True), ("no_dbs", 99.0, 0.0, 1.0, False)),
            "linear": (("random", 10.0, 10.0, 1.0, False), ("cdbs", 20.0, 20.0, 1.0, False)),
        }.items()
        for name, said, seen, error, supported in rows
    ]
    assert difference_errors(given["choice"]["predictions"]) == {"fqe": pytest.approx(4.0), "linear": 0.0}
    raw = tables(dlsm=True, linear=True, fqe=True)
    found = widened(raw, given)
    assert found["dlsm"] == raw["dlsm"]
    assert (found["linear"]["1"].low, found["linear"]["1"].high) == (raw["linear"]["1"].low, raw["linear"]["1"].high)
    fqe = found["fqe"]["1"]
    assert (fqe.low, fqe.high) == (pytest.approx(50.0 - math.hypot(1.0, 16.45)), pytest.approx(50.0 + math.hypot(1.0, 16.45)))
    gain = gain_over(found["fqe"]["2"], fqe)
    own = gain_over(raw["fqe"]["2"], raw["fqe"]["1"])  # the common error of level cancels, that of differences does not
    assert (gain.value, gain.high) == (10.0, pytest.approx(10.0 + math.hypot(own.high - 10.0, 1.645 * 4.0), abs=1e-6))
    parts = {"1": replace(raw["fqe"]["1"], details={"weights": {"fqe": 0.25, "linear": 0.75}})}
    assert widened({"aggregate": parts}, given)["aggregate"]["1"].low == pytest.approx(50.0 - math.hypot(1.0, 1.645 * 2.5))
    assert widened(raw, None) == raw


def test_the_choice_is_stored_and_shown_with_its_table(client: TestClient, policies: list[int], db: Session) -> None:
    participant = participant_by_code(db, "P1", SYSTEM)
    results = {m: {"estimates": {str(i): estimate(m, v) for i, v in zip(policies, values, strict=True)}} for m, values in (
        ("dlsm", (3.0, 2.0, 1.0)), ("fqe", (1.0, 2.0, 3.0)), ("linear", (1.0, 2.0, 3.0))
    )}  # fmt: skip
    store_evaluation(
        db, job_id=None, created_by="test", snapshot=take_snapshot(db, participant, SYSTEM), horizon_steps=60, candidates=policies,
        results=results, config={"methods": ["dlsm", "fqe", "linear", "aggregate"]},
        skill=outcome("fqe", skill("fqe", 0.12), skill("linear", 0.34)),
    )  # fmt: skip
    db.commit()
    stored = db.scalars(select(Evaluation)).one()
    assert (stored.default_method, stored.diagnostics["choice"]["chosen_by_data"]) == ("fqe", True)
    body = client.get("/api/v1/participants/P1/ranking").json()
    assert [p["policy_id"] for p in body["policies"]] == policies[::-1]
    assert body["methods"] == ["dlsm", "linear", "fqe", "aggregate"]
    assert [s["difference_error"] for s in body["choice"]["table"]] == [0.12, 0.34]
    page = client.get("/participants/P1/ranking").text
    assert "Fitted Q evaluation ranks by default. Fitted Q evaluation predicted the differences between 4 left-out controllers" in page
    assert "Which method to believe" in page
    assert "best on left-out controllers" in page


def test_the_reason_on_the_page_names_the_method(client: TestClient, policies: list[int], db: Session) -> None:
    participant = participant_by_code(db, "P1", SYSTEM)
    results = {m: {"estimates": {str(i): estimate(m, 1.0) for i in policies}} for m in ("fqe", "linear")}
    store_evaluation(
        db, job_id=None, created_by="test", snapshot=take_snapshot(db, participant, SYSTEM), horizon_steps=60, candidates=policies,
        results=results, config={}, skill=outcome("fqe", skill("fqe", 0.12), skill("linear", 0.34)),
    )  # fmt: skip
    db.commit()
    assert client.get("/api/v1/participants/P1/ranking").json()["choice"]["reason"].startswith("Fitted Q evaluation predicted")
    page = client.get("/participants/P1/ranking").text
    assert "Fitted Q evaluation ranks by default. Fitted Q evaluation predicted the differences" in page
    assert "fqe predicted" not in page


def test_an_evaluation_without_a_choice_is_still_shown(
    client: TestClient, policies: list[int], evaluate: Callable[..., int], db: Session
) -> None:
    evaluate({i: estimate("dlsm", 50.0) for i in policies})
    body = client.get("/api/v1/participants/P1/ranking").json()
    assert body["choice"]["chosen_by_data"] is False
    assert "No method was held against left-out controllers" in body["choice"]["reason"]
