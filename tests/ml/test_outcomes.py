"""The record of an outcome: its range, its direction, its margin, its failure and its part in r_end, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.mdp import MdpSettings
from ml.outcomes import BY_KEY, OUTCOMES
from ml.outcomes.records import Outcome
from ml.qoc import Margins, Qoc, failed_qoc

GRASP, RATING, TREMOR = (BY_KEY[key] for key in ("grasp", "rating", "tremor"))
FALLING = replace(GRASP, higher_is_better=False)


def test_every_name_of_an_outcome_is_its_own() -> None:
    for name in ("key", "field", "column", "label"):
        assert len({getattr(o, name) for o in OUTCOMES}) == len(OUTCOMES)
    assert len({o.margin.field for o in OUTCOMES}) == len(OUTCOMES)


@pytest.mark.parametrize(
    ("outcome", "inside", "outside"),
    [(GRASP, (0.0, 2.5), (-0.1, float("nan"), float("inf"))), (RATING, (1, 10), (0, 11, 5.5)), (TREMOR, (0.0, 100.0), (-1.0, 100.1))],
)
def test_a_value_lies_in_the_range(outcome: Outcome, inside: tuple[float, ...], outside: tuple[float, ...]) -> None:
    for value in inside:
        outcome.check(value)
        assert getattr(Qoc(**{outcome.field: value}), outcome.field) == value
    for value in outside:
        with pytest.raises(ValueError, match=f"{outcome.noun} must be .*not {value}"):
            Qoc(**{outcome.field: value})


@pytest.mark.parametrize(
    ("outcome", "own", "margin", "slack"),
    [
        (GRASP, 2.0, 0.1, 0.2),  # cDBS 2.0: 1.8 is still no worse
        (GRASP, 1.7, 0.1, -0.1),
        (RATING, 6.0, 1.0, 5.0),
        (TREMOR, 8.0, 10.0, 4.0),  # 12 is still no worse
        (TREMOR, 15.0, 10.0, -3.0),
        (FALLING, 2.3, 0.1, -0.1),  # 2.2 is still no worse
    ],
)
def test_a_value_keeps_within_its_margin_exactly_where_slack_is_not_below_zero(
    outcome: Outcome, own: float, margin: float, slack: float
) -> None:
    assert outcome.slack(own, 2.0, margin) == pytest.approx(slack)
    assert outcome.slack(np.array([own]), np.array([2.0]), margin) == pytest.approx([slack])
    # the same by the loss and the margin in the outcome's unit
    assert outcome.margin.amount(margin, 2.0) - outcome.loss(own - 2.0) == pytest.approx(slack)


def test_a_share_lowers_what_more_of_is_better_and_raises_what_less_of_is() -> None:
    assert GRASP.less_margin(2.0, 0.1) == pytest.approx(1.8)
    assert FALLING.less_margin(2.0, 0.1) == pytest.approx(2.2)


@pytest.mark.parametrize(
    ("outcome", "measured", "value"),
    [
        (GRASP, (2.0, None, 1.4, float("nan"), 3.0), 1.4),
        (FALLING, (2.0, 1.4, 3.0), 3.0),
        (GRASP, (None,), None),
        (GRASP, (), None),
        (RATING, (7, 3), 1),
        (TREMOR, (), 100.0),
    ],
)
def test_a_stopped_session_counts_as_the_stated_value_else_as_the_worst_measured(
    outcome: Outcome, measured: tuple[float | None, ...], value: float | None
) -> None:
    assert outcome.failed(measured) == value


def test_one_function_says_what_a_stopped_session_counts_as() -> None:
    sessions = [Qoc(2.2, 7, 10.0), Qoc(None, 8, None), Qoc(1.9, None, 0.0)]
    assert failed_qoc(sessions) == Qoc(1.9, 1, 100.0)
    assert failed_qoc([]) == Qoc(None, 1, 100.0)


def test_the_margins_are_those_of_the_records_and_each_is_above_zero() -> None:
    margins = Margins(0.2, tremor_points=5.0)
    assert [margins.of(o) for o in OUTCOMES[:3]] == [0.2, 1.0, 5.0]
    for wrong in ({"grasp_share": 1.0}, {"grasp_share": 0.0}, {"rating_points": 0.0}, {"tremor_points": float("nan")}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} must be above 0"):
            Margins(**wrong)


@pytest.mark.parametrize(("fraction", "of_tremor"), [(True, -0.3), (False, -30.0)])
def test_what_one_unit_of_an_outcome_adds_to_the_end_reward(fraction: bool, of_tremor: float) -> None:
    settings = MdpSettings(xi_beta=1.0, c2=10.0, c3=20.0, c4=30.0, tremor_as_fraction=fraction)
    assert [o.end.per_unit(settings) for o in OUTCOMES if o.end] == pytest.approx([10.0, 20.0, of_tremor])


@pytest.mark.parametrize(
    ("outcome", "change", "message"),
    [
        (GRASP, {"low": 3.0, "high": 3.0}, "range of grasp"),
        (RATING, {"resolution": 0.0}, "compared in steps"),
        (TREMOR, {"failure": 101.0}, "tremor must be"),
    ],
)
def test_a_record_that_cannot_be_is_refused(outcome: Outcome, change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(outcome, **change)
