"""Table of aims: its pick, loss, ratios and monotone map, against cases that are known by hand."""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@pytest.fixture
def answer(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Script with its own modules, as they are found when it is called."""
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    yield importlib.import_module("answer")
    for name in [n for n in sys.modules if n == "answer" or n.split(".")[0] == "support"]:
        del sys.modules[name]


def row(name: str, code: str, value: float, true: float, **changed: Any) -> dict[str, Any]:
    """Make a row whose candidate is safe and saves energy."""
    usual = {"gain": [-1.0, 1.0], "constant": False, "safe": True, "harm": False, "hazard": False, "worth": True}
    return {"name": name, "code": code, "value": value, "true": true, **usual, **changed}


CDBS = row("cDBS", "same_as_cdbs", 0.0, 0.0, constant=True, worth=False)


def test_the_pick_is_the_first_test_and_its_loss_is_to_the_best_safe_policy(answer: Any) -> None:
    rows = [
        row("a", "test", 5.0, 4.0),
        row("b", "test", 3.0, 8.0),
        row("c", "unsafe", 9.0, 10.0, safe=False, harm=True, hazard=True, worth=False),
        row("d", "undecided", 8.0, 0.0, constant=True),
        CDBS,
    ]
    assert answer.pick(rows)["name"] == "a"
    assert answer.loss(rows, answer.pick(rows)) == pytest.approx((8.0 - 4.0) / 10.0)
    assert answer.safe_pick(rows)["name"] == "d", "c is worth more and not safe"
    assert answer.following_pays(rows)
    found = answer.aims([rows])
    assert found["test: precision"][0] == 1.0
    assert found["test: recall"][0] == pytest.approx(2 / 3)
    assert found["unsafe that are worth a test"][0] == 0.0
    assert found["intervals to cDBS that cover"][0] == pytest.approx(1 / 4)
    # true returns 4, 8, 10, 0 have ranks 2, 3, 4, 1: by value a, b, c, d are 2, 1, 4, 3, and with c last 3, 2, 1, 4
    assert found["rank correlation by value"][0] == pytest.approx(1 - 6 * (0 + 4 + 0 + 4) / 60)
    assert found["rank correlation of the page"][0] == pytest.approx(1 - 6 * (1 + 1 + 9 + 9) / 60)
    assert found["the same, were harm and value known"][0] == pytest.approx(1 - 6 * (1 + 1 + 9 + 1) / 60)


def test_without_a_test_the_pick_is_cdbs(answer: Any) -> None:
    rows = [row("a", "undecided", 5.0, 4.0), row("b", "likely_worse", 1.0, -6.0), CDBS]
    assert answer.pick(rows) is CDBS
    assert answer.loss(rows, answer.pick(rows)) == pytest.approx(4.0 / 10.0)


def test_a_ratio_has_the_error_of_a_mean_where_all_worlds_weigh_the_same(answer: Any) -> None:
    values = np.array([0.0, 1.0, 1.0, 0.0])
    value, error = answer.ratio(values, [1.0] * 4)
    assert (value, error) == (0.5, pytest.approx(values.std() / math.sqrt(4)))
    assert math.isnan(answer.ratio([0.0], [0.0])[0])


def test_probabilities_are_compared_with_truth_between_edges(answer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answer, "calibrate", lambda share: share / 2)
    shares = [(0.2, False), (0.3, True), (0.9, True), (None, True)]
    rows = [row(str(k), "undecided", 0.0, 0.0, share=share, safe=safe) for k, (share, safe) in enumerate(shares)]
    assert answer.reliability([[*rows, CDBS]], (0.25, 0.75)) == [(2, 0.12, 0.5), (1, 0.45, 1.0)]


def test_the_map_pools_what_falls_and_keeps_what_rises(answer: Any) -> None:
    share = [0.1, 0.1, 0.4, 0.4, 0.6, 0.6, 0.9, 0.9]
    true = [False, False, True, True, False, True, True, True]
    # blocks 0, 1, 0.5, 1: the middle two are pooled to 0.75
    assert answer.monotone(share, true, blocks=4) == [(0.1, 0.0), (0.5, 0.75), (0.9, 1.0)]
