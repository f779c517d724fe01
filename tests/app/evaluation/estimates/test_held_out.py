"""Results of each method on held-out controllers: its intervals, the combination, what is stored and shown."""

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
from app.evaluation.estimates.held_out import combined, difference_errors, no_difference_error, widened
from app.evaluation.estimates.service import store_evaluation
from app.learning.snapshots import take_snapshot
from app.study.repository import participant_by_code
from app.tables.evaluations import Evaluation
from ml.ope.compare.gain import gain_over
from ml.ope.estimate import Estimate
from tests.app.evaluations import estimate, judged


def skill(method: str, error: float, bias: float = 1.0) -> dict[str, Any]:
    return {
        "method": method, "controllers": 4, "difference_error": error, "error": error, "bias": bias, "rank_correlation": 0.8,
        "pairs_in_order": 0.9,
    }  # fmt: skip


def outcome(*table: dict[str, Any]) -> dict[str, Any]:
    return {"held_out": {"table": list(table), "predictions": [], "failed": {}}}


def seen(method: str, **observed: float) -> list[dict[str, Any]]:
    return [{"method": method, "controller": name, "observed": value} for name, value in observed.items()]


NO_SKILL = outcome(skill("fqe", 0.7), skill("linear", 0.9))
NO_SKILL["held_out"]["predictions"] = seen("fqe", random=0.0, cdbs=4.0, no_dbs=10.0) + seen("linear", random=0.0, cdbs=4.0)


def tables(**supported: bool) -> dict[str, Any]:
    return {
        m: {"1": Estimate.from_json(estimate(m, 50.0, supported=s)), "2": Estimate.from_json(estimate(m, 60.0, supported=s))}
        for m, s in supported.items()
    }


def test_the_error_without_skill_is_that_of_saying_that_all_controllers_are_alike() -> None:
    predictions = NO_SKILL["held_out"]["predictions"]
    assert no_difference_error(predictions) == pytest.approx((4 + 10 + 6) / 3 / 10)
    assert no_difference_error(predictions[:1]) is None
    assert no_difference_error([]) is None


def test_only_methods_of_known_bias_are_combined() -> None:
    made = combined(tables(dlsm=True, linear=True, fqe=True), outcome(skill("fqe", 0.1), skill("linear", 0.3, bias=9.0)))
    weights = made["estimates"]["1"].details["weights"]
    assert set(weights) == {"fqe", "linear"}
    assert weights["fqe"] > 0.9  # its squared error is some hundredth of the other's
    assert "at least two methods" in combined(tables(dlsm=True, fqe=True), outcome(skill("fqe", 0.1)))["failed"]
    assert "supports any policy" in combined(tables(dlsm=False, fqe=False), None)["failed"]


def test_intervals_are_widened_by_the_errors_on_left_out_controllers() -> None:
    given = outcome(skill("fqe", 0.1) | {"excess": 10.0}, skill("linear", 0.2) | {"excess": 0.0})
    given["held_out"]["predictions"] = [
        {"method": m, "controller": name, "predicted": said, "observed": seen, "observed_standard_error": error, "supported": supported}
        for m, rows in {
            # fqe: differences of supported controllers off by 5 with a noise of 3 and 0; the third controller was not supported
            "fqe": (("random", 10.0, 10.0, 3.0, True), ("cdbs", 25.0, 20.0, None, True), ("no_dbs", 99.0, 0.0, 1.0, False)),
            "linear": (("random", 10.0, 10.0, 1.0, False), ("cdbs", 20.0, 20.0, 1.0, False)),
        }.items()
        for name, said, seen, error, supported in rows
    ]
    assert difference_errors(given["held_out"]["predictions"]) == {"fqe": pytest.approx(4.0), "linear": 0.0}
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


def test_what_left_out_controllers_showed_is_stored_and_shown_in_the_fold_and_chooses_nothing(
    client: TestClient, policies: list[int], db: Session
) -> None:
    participant = participant_by_code(db, "P1", SYSTEM)
    results = {m: {"estimates": {str(i): estimate(m, v) for i, v in zip(policies, values, strict=True)}} for m, values in (
        ("dlsm", (3.0, 2.0, 1.0)), ("fqe", (1.0, 2.0, 3.0)), ("linear", (1.0, 2.0, 3.0))
    )}  # fmt: skip
    results["posterior"] = {"estimates": {str(i): judged(float(k)) for k, i in enumerate(policies)}}
    store_evaluation(
        db, job_id=None, created_by="test", snapshot=take_snapshot(db, participant, SYSTEM), horizon_steps=60, candidates=policies,
        results=results, config={"methods": ["dlsm", "fqe", "linear", "aggregate", "posterior"]},
        skill=outcome(skill("fqe", 0.12), skill("linear", 0.34)),
    )  # fmt: skip
    db.commit()
    found = db.scalars(select(Evaluation)).one()
    assert found.default_method == "posterior"
    assert [row["difference_error"] for row in found.diagnostics["held_out"]["table"]] == [0.12, 0.34]
    body = client.get("/api/v1/participants/P1/ranking").json()
    assert body["choice"] is None
    assert set(body["methods"]) == {"dlsm", "linear", "fqe", "aggregate", "posterior"}
    page = client.get("/participants/P1/ranking").text
    fold = page[page.index('class="fold"') :]
    assert "Single methods on controllers that they had not seen" in fold
    assert "Fitted Q evaluation" not in page[page.index('id="ranking"') : page.index('class="fold"')]


def test_why_no_method_could_be_held_against_the_sessions_is_shown(
    client: TestClient, policies: list[int], evaluate: Callable[..., int], db: Session
) -> None:
    evaluate({i: estimate("dlsm", 50.0) for i in policies})
    assert "Single methods on controllers" not in client.get("/participants/P1/ranking").text
    participant = participant_by_code(db, "P1", SYSTEM)
    store_evaluation(
        db, job_id=None, created_by="test", snapshot=take_snapshot(db, participant, SYSTEM), horizon_steps=60, candidates=policies,
        results={"dlsm": {"estimates": {str(i): estimate("dlsm", 1.0) for i in policies}}}, config={}, skill={"failed": "too few sessions"},
    )  # fmt: skip
    db.commit()
    assert "could not predict left-out controllers: too few sessions" in client.get("/participants/P1/ranking").text


def test_the_posterior_is_no_part_of_the_combination() -> None:
    made = combined(tables(dlsm=True, linear=True, posterior=True), None)
    assert set(made["estimates"]["1"].details["weights"]) == {"dlsm", "linear"}
