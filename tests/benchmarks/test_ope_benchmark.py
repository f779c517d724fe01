"""The evaluation benchmark's own arithmetic: scores in closed form, the count of looks, and figures out of cells."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def module(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    yield importlib.import_module
    for name in [n for n in sys.modules if n.split(".")[0] == "support"]:
        del sys.modules[name]


def rows(values, half=1.0, supported=True):
    return [{"value": v, "low": v - half, "high": v + half, "supported": supported} for v in values]


def test_perfect_estimates_have_perfect_scores(module):
    found = module("support.ope_scores").world_scores([0.0, 5.0, 10.0, 4.0], rows([0.0, 5.0, 10.0, 4.0], 0.5), cdbs=4.0)
    assert found["rank"] == 1
    assert found["regret"] == found["mae"] == found["worst first"] == 0
    assert found["coverage"] == 1
    assert found["width"] == pytest.approx(0.1)
    assert found["interval score"] == pytest.approx(0.1)
    # the best three return 10, 5 and 4; the best is 6 above cDBS
    assert found["sharpe"] == pytest.approx(6 / np.std([10.0, 5.0, 4.0]))


def test_a_confident_reversal_is_named_and_costs_the_range(module):
    found = module("support.ope_scores").world_scores([0.0, 5.0, 10.0], rows([10.0, 5.0, 0.0], 1.0), cdbs=5.0)
    assert found["rank"] == -1
    assert found["regret"] == 1
    assert found["worst first"] == 1
    assert found["mae"] == pytest.approx(20 / 30)
    # two of three are missed by 9; 20 times that each
    assert found["interval score"] == pytest.approx((2 + (20 * 9 * 2) / 3) / 10)
    wide = module("support.ope_scores").world_scores([0.0, 5.0, 10.0], rows([10.0, 5.0, 0.0], 10.0), cdbs=5.0)
    assert wide["worst first"] == 0


def test_unsupported_candidates_count_in_all_and_not_among_supported(module):
    found = rows([0.0, 5.0, 10.0]) + rows([99.0], supported=False)
    scores = module("support.ope_scores").world_scores([0.0, 5.0, 10.0, -5.0], found, cdbs=0.0)
    assert scores["rank supported"] == 1
    assert scores["rank"] < 1
    assert scores["supported"] == 0.75


def test_signs_are_told_right_wrong_or_not(module):
    told = module("support.ope_scores").Told
    right, wrong, silent, unclear = told(1, 2, 5, 1), told(1, 2, -5, 1), told(-1, 2, 5, 1), told(1, 2, 1, 1)
    assert (right.right, wrong.right, silent.right, unclear.right) == (True, False, None, None)
    share, unknown = module("support.ope_scores").signs([right, right, wrong, silent, unclear])
    assert share == pytest.approx(2 / 3)
    assert unknown == pytest.approx(0.2)


def test_the_worst_decile_is_on_the_bad_side(module):
    values = list(range(11))
    assert module("support.ope_scores").over_worlds(values, worst_is_low=True)["decile"] == 1
    assert module("support.ope_scores").over_worlds([*values, None], worst_is_low=False)["decile"] == 9


def test_testing_more_sessions_ranks_better(module):
    scores = module("support.ope_scores").scores_of_tests
    few, many = (scores([0, 1, 2, 3, 4], [3.0] * 5, 0.0, n)["rank"] for n in (5, 500))
    assert few < many
    assert many > 0.95


def test_looks_at_b_and_c_are_counted_and_c_is_run_once_per_release(module, tmp_path):
    looks, file = module("support.looks"), tmp_path / "looks.json"
    file.write_text('{"B": [], "C": []}')
    looks.look("A", "a", file=file)
    looks.look("B", "b", file=file)
    looks.look("B", "b", file=file)
    with pytest.raises(looks.LookError, match="--release"):
        looks.look("C", "c", file=file)
    looks.look("C", "c", "1.0", file=file)
    with pytest.raises(looks.LookError, match=r"release 1\.0"):
        looks.look("C", "c", "1.0", file=file)
    assert looks.said(file) == "part B has been looked at 2 times; part C has been looked at 1 time"
    looks.look("B", f"ope.py --part B --out {tmp_path}", file=file)
    assert looks.counts(file)["B"][-1]["what"] == "ope.py --part B --out FOLDER"


def test_the_count_in_the_repository_can_be_read(module):
    assert set(module("support.looks").counts()) == {"B", "C"}


class Known(dict):
    def get(self, key):
        return super().get(key)


def cells_of(name, values, flat=False):
    truth = {n: {"total": [v, 0.1], "returns_sd": 1.0} for n, v in {"a": 0.0, "b": 5.0, "c": 10.0, "cDBS": 8.0}.items()}
    on_days = {n: {"total": t["total"]} for n, t in truth.items() if n != "cDBS"}
    estimates = dict(zip("abc", rows(values), strict=True))
    method = {"estimates": estimates, "dose": [1.0, 2.0], "follow": [-1.0, 1.0], "seconds": 1.0}
    return {
        f"{name}/truth": {
            "policies": truth, "on_days": on_days, "dose": [3.0, 0.1], "follow": [0.0, 1.0],
            "responder": True, "silent": False, "flat": flat, "sessions": 6,
        },
        f"{name}/paper/linear": method,
        f"{name}/paper/posterior": method | {"estimates": dict(zip("cba", rows(values), strict=True))},
        f"{name}/stratified/posterior": method,
    }  # fmt: skip


def test_figures_come_from_the_headline_with_both_designs(module, tmp_path):
    cells = Known(cells_of("A00", [0.0, 5.0, 10.0]) | cells_of("A01", [0.0, 5.0, 10.0], flat=True))
    text: list[str] = []
    made = module("support.ope_report")
    summary = made.report(["A00", "A01"], cells, "posterior", tmp_path / "ope.svg", text.append)
    figures = made.figures(summary, "posterior")
    contract = (
        "n_worlds", "rank_mean", "rank_worst_decile", "regret_mean", "mae_mean", "coverage", "median_width", "interval_score",
        "dose_sign_right", "dose_sign_unknown", "worst_first_confident",
    )  # fmt: skip
    assert set(figures) == {c + s for c in contract for s in ("", "_paper")}
    assert (figures["n_worlds"], figures["rank_mean"], figures["rank_mean_paper"]) == (1, 1, -1)
    assert (figures["dose_sign_right"], figures["dose_sign_unknown"], figures["mae_mean"]) == (1, 0, 0)
    assert "A01" in "".join(text)
    assert (tmp_path / "ope.svg").read_text().startswith("<svg")
    dots = (tmp_path / "ope-worlds.svg").read_text()
    # one world each: the posterior with both designs, linear, and both oracles with both; the flat world is excluded
    assert dots.count("<circle") == 7
    assert "posterior, paper" in dots
    assert json.dumps(figures)
