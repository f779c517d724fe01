"""Decisions follow their stated rules; gains are differences in which what two estimates share cancels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app.evaluation import wording
from app.evaluation.decision import RULES, decide, gain_over
from app.evaluation.schemas import TestedBefore
from ml.ope.estimate import Estimate
from ml.ope.flags import Flag
from ml.ope.support.coverage import thin

STORED_WORDS = Flag.of("text", text="in 13 % of steps")
OUTCOMES = {"rating": 7.0, "tremor_percent": 20.0, "grasp_hz": 2.0}


def made(value: float, spread: float = 1.0, method: str = "fqe", **more: Any) -> Estimate:
    known = {
        "low": value - spread, "high": value + spread, "level": 0.9, "standard_error": spread / 1.645, "step_return": value - 80,
        "end_reward": 80.0, "predicted": OUTCOMES, "supported": True, "flags": (), "n": 10,
    }  # fmt: skip
    return Estimate(method=method, value=value, **(known | more))


def returned(n: int, mean: float) -> TestedBefore:
    return TestedBefore(
        sessions=n, sessions_with_return=n, mean_return=mean, mean_step_return=mean - 80, mean_end_reward=80.0, energy=None, mean_beta=None,
        grasp_hz=None, rating=None, tremor_percent=None,
    )  # fmt: skip


CDBS = {"fqe": made(50.0), "linear": made(50.0, method="linear")}


def test_what_two_estimates_share_cancels_in_their_gain() -> None:
    rng = np.random.default_rng(0)
    common, own = 20 * rng.standard_normal(400), 0.5 * rng.standard_normal(400)
    reference = made(50.0, 33.0, details={"draws": list(50 + common)})
    policy = made(52.0, 33.0, details={"draws": list(52 + common + own)})
    gain = gain_over(policy, reference)
    centred = own - own.mean()
    assert (gain.value, gain.low, gain.high) == (
        2.0, pytest.approx(2 + np.quantile(centred, 0.05)), pytest.approx(2 + np.quantile(centred, 0.95))
    )  # fmt: skip
    alone = gain_over(replace(policy, details={}), replace(reference, details={}))
    assert alone.high - alone.value == pytest.approx(33.0 * 2**0.5, rel=1e-3)


@pytest.mark.parametrize(
    ("own", "more", "decision", "named"),
    [
        (made(60.0), {}, "test_next", "lower 95 % bound is above 0"),
        (made(60.0), {"retired_reason": "battery"}, "reject", "retired: battery"),
        (made(40.0), {}, "reject", "all of it below 0"),
        (made(51.0), {}, "needs_data", "it may be none"),
        (made(60.0, supported=False, flags=(thin(0.4, "logged"),)), {}, "needs_data", "in 40 % of steps"),
        (
            made(40.0, supported=False, flags=(STORED_WORDS,)),
            {},
            "needs_data",
            "not supported by the data; in 13 % of steps",
        ),
        (
            made(40.0, supported=False, flags=(STORED_WORDS,), details={"coverage_simulated": {"thin": 0.32}}),
            {},
            "needs_data",
            "in its simulated sessions, in 32 % of steps",
        ),
        (made(60.0, predicted=OUTCOMES | {"rating": 5.9}), {}, "needs_data", "rating is predicted at 5.9 against 7.0"),
        (made(60.0, predicted=OUTCOMES | {"tremor_percent": 31.0}), {}, "needs_data", "tremor is predicted at 31 % against 20 %"),
        (made(60.0, predicted=OUTCOMES | {"grasp_hz": 1.7}), {}, "needs_data", "grasp is predicted at 1.70 Hz against 2.00 Hz"),
        (made(60.0, predicted=OUTCOMES | {"rating": 6.1, "tremor_percent": 29.0, "grasp_hz": 1.85}), {}, "test_next", "above 0"),
        (made(60.0), {"tested": returned(3, 55.0)}, "needs_data", "3 sessions returned 55.0 on average, below the estimate's 59.0"),
        (made(60.0), {"tested": returned(2, 55.0)}, "test_next", "above 0"),
        (made(60.0), {"tested": returned(9, 59.5)}, "test_next", "above 0"),
    ],
)
def test_a_decision_gives_the_rule_that_made_it(own: Estimate, more: dict[str, Any], decision: str, named: str) -> None:
    found, reasons = decide({"fqe": own}, CDBS, "fqe", **more)
    assert (found, named in wording.decision(reasons)) == (decision, True), reasons


def test_another_method_that_sees_a_loss_asks_for_more_data() -> None:
    found, reasons = decide({"fqe": made(60.0), "linear": made(40.0, method="linear")}, CDBS, "fqe")
    assert found == "needs_data"
    assert reasons[-1].code == "method_sees_loss"
    assert "Linear model sees a loss" in wording.decision(reasons)
    unsure = made(40.0, method="linear", supported=False)
    assert decide({"fqe": made(60.0), "linear": unsure}, CDBS, "fqe")[0] == "test_next"


def test_without_a_supported_cdbs_reference_nothing_is_proposed() -> None:
    assert decide({"fqe": made(60.0)}, {}, "fqe")[0] == "needs_data"
    unsupported = {"fqe": made(50.0, supported=False, flags=(thin(0.4, "logged"),))}
    found, reasons = decide({"fqe": made(60.0)}, unsupported, "fqe")
    assert (found, [r.code for r in reasons]) == ("needs_data", ["reference_unsupported", "thin"])
    assert "is itself not supported by the data: in 40 %" in wording.decision(reasons)


def test_the_printed_rules_name_every_decision() -> None:
    assert [rule.split(":")[0].split(",")[0] for rule in RULES] == ["Reject", "Needs more data", "Needs more data", "Test next"]
