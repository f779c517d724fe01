"""Verdicts from constructed draws, in which every probability is known: each code, its levels, its margins, the order of precedence."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ml.ope.flags import Flag
from ml.ope.posterior import verdict as module
from ml.ope.posterior.verdict import HAZARDS, Levels, Verdict, calibrate, interval, verdict
from ml.qoc import Margins
from tests.ml.ope.posterior.draws import N, cdbs, constructed, share


@pytest.fixture(autouse=True)
def plain_chances(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chances are the shares of draws, so that they are known in closed form."""
    if "calibration" not in request.node.name:
        monkeypatch.setattr(module, "CALIBRATION", ((0.0, 0.0), (1.0, 1.0)))


def of(reference: Any = None, margins: Margins | None = None, levels: Levels | None = None, **changed: Any) -> Verdict:
    """Return the verdict on a constructed candidate with the default margins and levels."""
    told = {name: changed.pop(name) for name in ("harms", "unchecked") if name in changed}
    return verdict(constructed(**changed), reference or cdbs(), margins or Margins(), levels or Levels(), **told)


def codes(found: Verdict) -> list[str]:
    return [reason.code for reason in found.reasons]


def test_a_policy_within_all_margins_that_saves_energy_is_worth_a_test() -> None:
    found = of()
    assert (found.code, found.within, found.saves, found.limit) == ("test", 1.0, 1.0, None)
    assert [(r.code, r.value, r.limit, r.unit) for r in found.reasons] == [
        ("within_margins", 1.0, 0.8, "probability"),
        ("saves_energy", 1.0, 0.9, "probability"),
    ]


@pytest.mark.parametrize(("beyond", "code"), [(0.2, "test"), (0.201, "undecided"), (0.799, "undecided"), (0.8, "likely_worse")])
@pytest.mark.parametrize(
    ("name", "good", "bad"),
    # the bad value is just beyond its margin of 10 %, 1 point, 10 percentage points, the good one just within
    [("grasp_hz", 1.801, 1.799), ("rating", 6.001, 5.999), ("tremor_percent", 29.999, 30.001)],
)
def test_each_outcome_has_its_margin_and_its_levels(name: str, good: float, bad: float, beyond: float, code: str) -> None:
    found = of(outcome_draws={name: share(beyond, good, bad)})
    assert found.code == code
    assert found.within == pytest.approx(1 - beyond)


@pytest.mark.parametrize(("same", "code"), [(0.1, "test"), (0.101, "undecided")])
def test_a_test_saves_energy_with_the_stated_probability(same: float, code: str) -> None:
    found = of(outcome_draws={"energy": share(same, 0.7, 1.0)})
    assert (found.code, found.saves) == (code, pytest.approx(1 - same))


def test_outcomes_count_together_and_not_one_by_one() -> None:
    """Each outcome alone is within its margin with 0.85; the three are bad in different draws, so that all are within with 0.55."""
    third = [share(0.15, 2.0, 1.0), share(0.15, 7.0, 1.0)[::-1], [20.0] * 400 + [60.0] * 150 + [20.0] * 450]
    found = of(outcome_draws=dict(zip(("grasp_hz", "rating", "tremor_percent"), third, strict=True)))
    assert found.within == pytest.approx(0.55)
    assert found.code == "undecided"


@pytest.mark.parametrize(("harm", "code"), [(0.899, "likely_worse"), (0.9, "unsafe")])
@pytest.mark.parametrize(
    ("name", "bad", "mild"),
    # twice the margin of 10 %, 1 point, 10 percentage points, and a loss just short of it
    [("grasp_hz", 1.599, 1.601), ("rating", 4.999, 5.001), ("tremor_percent", 40.001, 39.999)],
)
def test_unsafe_is_what_does_harm_beyond_twice_a_margin_almost_surely(name: str, bad: float, mild: float, harm: float, code: str) -> None:
    assert of(outcome_draws={name: share(harm, mild, bad)}).code == code
    assert of(outcome_draws={name: [mild] * N}).code == "likely_worse"


def test_a_likely_loss_names_its_outcome_and_chance() -> None:
    found = of(outcome_draws={"rating": share(0.85, 7.0, 5.5)})
    assert (found.reasons[0].code, found.reasons[0].value, found.reasons[0].fact("outcome")) == ("likely_beyond_margin", 0.85, "rating")
    assert found.hazards == ()


def test_the_calibration_is_monotone_and_corrects_chances_that_are_too_low() -> None:
    said, true = zip(*module.CALIBRATION, strict=True)
    assert list(said) == sorted(said)
    assert list(true) == sorted(true)
    assert all(0 <= v <= 1 for v in (*said, *true))
    assert calibrate(0.5) > 0.6
    middle = (said[1] + said[2]) / 2
    assert calibrate(middle) == pytest.approx((true[1] + true[2]) / 2)
    found = of(outcome_draws={"rating": share(0.5, 7.0, 1.0)})
    assert found.within == pytest.approx(calibrate(0.5))


def test_draws_are_compared_with_those_of_cdbs_one_by_one() -> None:
    """Errors of the posterior that are the same for both cancel: both trembling from 0 to 100 % of the time is no doubt about the
    difference.
    """
    both = share(0.5, 0.0, 90.0)
    assert of(cdbs(outcome_draws={"tremor_percent": both}), outcome_draws={"tremor_percent": both}).code == "test"
    assert of(cdbs(outcome_draws={"tremor_percent": both[::-1]}), outcome_draws={"tremor_percent": both}).within == 0.5


def test_margins_and_levels_are_the_participants() -> None:
    risky = {"outcome_draws": {"tremor_percent": [26.0] * N}}
    assert of(**risky).code == "test"
    assert of(margins=Margins(tremor_points=5.0), **risky).code == "likely_worse"
    assert of(margins=Margins(tremor_points=2.5), **risky).code == "unsafe"
    doubtful = {"outcome_draws": {"tremor_percent": share(0.3, 20.0, 60.0)}}
    assert of(**doubtful).code == "undecided"
    assert of(levels=Levels(test_within=0.7), **doubtful).code == "test"
    assert of(levels=Levels(unsafe_beyond=0.3), **doubtful).code == "unsafe"
    with pytest.raises(ValueError, match="probabilities"):
        Levels(test_within=1.2)
    with pytest.raises(ValueError, match="above 0"):
        Margins(tremor_points=0.0)


@pytest.mark.parametrize(("off", "code"), [(0.2, "test"), (0.21, "unsafe")])
def test_a_policy_that_is_nearly_off_is_unsafe_whatever_is_predicted(off: float, code: str) -> None:
    found = of(behaviour={"below_cdbs_20_percent": off})
    assert found.code == code
    if code == "unsafe":
        assert [(h.code, h.value, h.limit) for h in found.hazards] == [("nearly_off", off, 0.2)]


def test_a_serious_adverse_event_that_nobody_cleared_is_unsafe() -> None:
    found = of(harms=(Flag("adverse_event"),))
    assert (found.code, codes(found)[0], found.proposed) == ("unsafe", "adverse_event", False)


def test_an_unsupported_but_promising_policy_is_tested_with_care_down_to_the_lowest_dose_of_two_sessions() -> None:
    found = of(supported=False, support={"dose": 0.45, "lowest_supported": 0.55})
    assert (found.code, found.limit, found.proposed) == ("test_with_care", 0.55, True)
    assert codes(found)[:2] == ["extrapolates", "thin"], "what the policy does, and the check that it failed"
    assert (found.reasons[0].value, found.reasons[0].limit) == (0.45, 0.55)


def test_without_a_dose_that_two_sessions_held_there_is_no_test_with_care() -> None:
    found = of(supported=False, support={"lowest_supported": None})
    assert (found.code, found.limit) == ("undecided", None)


def test_an_unsupported_policy_that_does_not_promise_is_undecided() -> None:
    found = of(supported=False, outcome_draws={"rating": share(0.3, 7.0, 1.0)})
    assert (found.code, codes(found)[0]) == ("undecided", "thin")


def test_a_policy_that_acts_like_cdbs_is_called_the_same() -> None:
    found = of(behaviour={"closeness_to_cdbs": 0.02}, outcome_draws={"energy": [0.97] * N})
    assert (found.code, found.proposed) == ("same_as_cdbs", False)
    assert of(behaviour={"closeness_to_cdbs": 0.06}).code == "test"


@pytest.mark.parametrize(
    ("changed", "code"),
    [
        ({}, "test"),
        ({"supported": False}, "test_with_care"),
        ({"behaviour": {"closeness_to_cdbs": 0.0}}, "same_as_cdbs"),
        ({"behaviour": {"below_cdbs_20_percent": 0.9}}, "unsafe"),
        ({"outcome_draws": {"rating": [1.0] * N}}, "unsafe"),
        ({"harms": (Flag("stopped", 1.0, None, "stops"),)}, "unsafe"),
        ({"unchecked": "no session has a whole window"}, "cannot_tell"),
    ],
)
def test_a_want_of_ordering_skill_is_a_reason_and_changes_no_verdict(changed: dict[str, Any], code: str) -> None:
    assert of(**changed).code == code
    unskilled = next(r for r in of(told=False, **changed).reasons if r.code == "no_ordering_skill")
    assert of(told=False, **changed).code == code
    assert unskilled.fact("reasons") == ("no_better_than_equal",)


def test_a_posterior_that_states_no_skill_has_none() -> None:
    own = constructed()
    del own.details["skill"]
    assert "no_ordering_skill" in codes(verdict(own, cdbs(), Margins(), Levels()))


def test_the_order_of_precedence() -> None:
    """A candidate to which everything applies; each step takes the strongest finding away."""
    everything: dict[str, Any] = {
        "supported": False,
        "behaviour": {"below_cdbs_20_percent": 0.5, "closeness_to_cdbs": 0.01},
        "outcome_draws": {},
        "unchecked": "the checks failed",
    }
    found = [of(**everything).code]
    everything["behaviour"] = {"closeness_to_cdbs": 0.01}
    found.append(of(**everything).code)
    del everything["unchecked"]
    found.append(of(**everything).code)
    everything["behaviour"] = {}
    found.append(of(**everything).code)
    everything["supported"] = True
    found.append(of(**everything).code)
    assert found == ["unsafe", "cannot_tell", "same_as_cdbs", "test_with_care", "test"]


def test_what_is_not_known_about_cdbs_or_the_outcomes_cannot_be_told() -> None:
    assert codes(verdict(constructed(), None, Margins(), Levels()))[0] == "reference_missing"
    assert codes(of(cdbs(supported=False)))[0] == "reference_unsupported"
    nothing = dict.fromkeys(("grasp_hz", "rating", "tremor_percent"))
    unknown = of(outcome_draws=nothing)
    assert (unknown.code, codes(unknown)[0], unknown.within) == ("cannot_tell", "outcomes_unknown", None)
    assert codes(of(outcome_draws={"energy": None}))[0] == "energy_unknown"
    assert of(outcome_draws={"rating": None}).code == "test", "one outcome that the study does not take stands in nobody's way"


def test_draws_that_are_too_few_not_finite_or_not_aligned_tell_no_probability() -> None:
    assert codes(of(outcome_draws={"energy": [0.6] * 10}))[0] == "energy_unknown"
    broken = [float("nan")] * N
    assert codes(of(outcome_draws=dict.fromkeys(("grasp_hz", "rating", "tremor_percent"), broken)))[0] == "outcomes_unknown"
    with pytest.raises(ValueError, match="not aligned"):
        of(outcome_draws={"rating": [7.0] * (N - 1)})


def test_every_hazard_is_a_reason_that_some_verdict_gives() -> None:
    each = (
        of(harms=(Flag("adverse_event"), Flag("stopped"))),
        of(behaviour={"below_cdbs_20_percent": 0.5}),
        of(outcome_draws={"rating": [1.0] * N}),
    )
    assert {hazard.code for found in each for hazard in found.hazards} == HAZARDS


@pytest.mark.parametrize("n", [1, 2, 19, 200, 401])
def test_the_interval_of_draws_is_that_of_numpy(n: int) -> None:
    draws = np.random.default_rng(n).normal(3.0, 2.0, n)
    assert interval(draws) == pytest.approx(tuple(np.quantile(draws, [0.05, 0.95])), rel=1e-12)
