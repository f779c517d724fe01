"""A method's record in sentences, the metrics visit by visit, and the table for other programs."""

from __future__ import annotations

import csv
import datetime as dt
import io
from collections.abc import Sequence
from typing import Any

import pytest

from app.analysis.calibration import in_sentences
from app.analysis.calibration_accuracy import CalibrationOut, Pair, PredictionOut, TestedPolicyOut, accuracies
from app.analysis.calibration_charts import over_visits
from app.analysis.calibration_web import calibration_to_csv


def at_visit(visit: int, policy: int, predicted: float, actual: float, **more: Any) -> TestedPolicyOut:
    prediction = PredictionOut(
        method="linear", supported=True, parts="return", predicted=predicted, low=predicted - 2, high=predicted + 2, level=0.9,
        actual=actual, actual_low=None, actual_high=None, sessions=1, session_returns=[actual], quantities=[],
    )  # fmt: skip
    values: dict[str, Any] = {
        "visit": visit, "visit_date": dt.date(2026, 3, visit), "evaluation_id": visit,
        "evaluated_at": dt.datetime(2026, 3, 1, tzinfo=dt.UTC), "policy_id": policy, "name": f"p{policy}", "kind": "trained",
        "reference": None, "horizon_steps": 60, "gamma": 0.99, "sessions": 1, "sessions_left_out": [], "predictions": [prediction],
    }  # fmt: skip
    return TestedPolicyOut(**(values | more))


def calibration(policies: Sequence[TestedPolicyOut]) -> CalibrationOut:
    pairs = [
        Pair(p.visit, q.predicted, q.low, q.high, tuple(q.session_returns)) for p in policies if not p.reference for q in p.predictions
    ]
    return CalibrationOut(
        participant="P1", beta_unit="uV", level=0.9, methods=["linear"], policies=list(policies),
        metrics=accuracies("linear", pairs) if pairs else [], quantities=[], missing=None, left_out=[],
    )  # fmt: skip


WRONG_WAY = [at_visit(v, k, 10.0 + k, 20.0 - k) for v in (2, 3) for k in range(4)]
RIGHT_WAY = [at_visit(v, k, 10.0 + k, 11.0 + k) for v in (2, 3) for k in range(4)]


def test_a_good_record_says_distance_order_choice_and_intervals() -> None:
    found = in_sentences(calibration(RIGHT_WAY), "linear")
    assert found == [
        "What a session is worth was predicted 1.0 off in the mean (33 % of the range of what was seen), over 8 tests of a policy at 2 "
        "visits, on average 1.0 too low.",
        "Policies were put in the right order better than by chance (rank correlation 1.00, p < 0.01).",
        "At every visit the policy put first was worth the most.",
        "The 90 % intervals held the truth in 8 of 8 tests.",
    ]


def test_a_bad_record_is_said_as_plainly() -> None:
    found = in_sentences(calibration(WRONG_WAY), "linear")
    assert found[1] == "Policies were put in the wrong order (rank correlation -1.00, p < 0.01)."
    assert found[2].startswith("The policy put first was worth 3.0 less than the best of its visit, 100 % of the visit's range")
    assert found[3] == "The 90 % intervals held the truth in 0 of 8 tests."


def test_too_little_is_said_to_be_too_little_and_cdbs_is_not_counted() -> None:
    found = in_sentences(calibration([at_visit(2, 1, 12.0, 10.0), at_visit(2, 9, 50.0, 0.0, reference="cdbs")]), "linear")
    assert (
        found[0]
        == "What a session is worth was predicted 2.0 off in the mean, over 1 test of a policy at 1 visit, on average 2.0 too high."
    )
    assert found[1].startswith("Whether policies were put in the right order cannot be said")
    assert found[2].startswith("What going by it cost cannot be said: a ranking needs at least 2 policies at one visit")
    assert found[-1] == "1 test of a policy is few: much of this may be chance."
    assert in_sentences(calibration([]), "fqe") == []


def test_the_chart_over_visits_has_the_metrics_of_each_visit() -> None:
    chart = over_visits(calibration([*WRONG_WAY[:4], *RIGHT_WAY[4:]]), "linear")
    assert chart is not None
    mae, rank, regret = chart.figure["data"]
    assert (mae["x"], mae["y"]) == ([2, 3], [pytest.approx(7.0), pytest.approx(1.0)])
    assert rank["y"] == [pytest.approx(-1.0), pytest.approx(1.0)]
    assert regret["y"] == [pytest.approx(1.0), pytest.approx(0.0)]
    assert [row[:2] for row in chart.rows] == [[2, "Linear model"], [3, "Linear model"]]
    assert over_visits(calibration(WRONG_WAY[:4]), "linear") is None


def test_the_csv_has_a_row_for_every_visit_policy_and_method() -> None:
    rows = list(csv.DictReader(io.StringIO(calibration_to_csv(calibration([at_visit(2, 1, 12.0, 10.0, name="=cmd()")])))))
    assert len(rows) == 1
    assert {n: rows[0][n] for n in ("visit", "name", "method", "predicted", "actual", "session_returns", "rating_predicted")} == {
        "visit": "2", "name": "'=cmd()", "method": "linear", "predicted": "12.0", "actual": "10.0", "session_returns": "10",
        "rating_predicted": "",
    }  # fmt: skip
