"""Figures without a script: ticks, places of labels, lines with gaps, and words that are no markup."""

from __future__ import annotations

from itertools import pairwise

import pytest

from app.platform.web.svg import Plane, apart, drawing, nice_ticks


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [(0, 3.24, [0, 1, 2, 3]), (0.07, 0.093, [0.07, 0.075, 0.08, 0.085, 0.09]), (-1, 1, [-1, -0.5, 0, 0.5, 1]), (2, 2, [2])],
)
def test_ticks_are_round_and_inside(low: float, high: float, ticks: list[float]) -> None:
    assert nice_ticks(low, high) == pytest.approx(ticks)


def test_labels_keep_apart_and_stay_inside() -> None:
    placed = apart([10.0, 11.0, 99.0, 100.0], gap=14, low=0, high=100)
    assert sorted(placed) == placed
    assert min(b - a for a, b in pairwise(placed)) >= 14 - 1e-9
    assert (placed[0], placed[-1]) == (10.0, 100.0)


def test_a_line_breaks_where_nothing_is_known_and_holds_its_value_where_it_steps() -> None:
    plane = Plane(0, 0, 100, 100, (0, 4), (0, 1))
    plane.line([(0, 0.0), (1, 1.0), (2, None), (3, 1.0), (4, 0.0)], "rl")
    assert plane.parts[-1].count("M") == 2
    plane.line([(0, 0.0), (4, 1.0)], "rl", step=True)
    assert "M0.0 100.0L100.0 100.0L100.0 0.0" in plane.parts[-1]


def test_words_are_no_markup() -> None:
    plane = Plane(0, 0, 100, 100, (0, 1), (0, 1))
    plane.text(0, 0, "<script>")
    plane.dot(0, 0, "rl", words='"><b>')
    made = drawing(100, 100, "a & b", '"c"', [plane])
    assert "<script>" not in made
    assert "<b>" not in made
    assert 'aria-label="a &amp; b. &quot;c&quot;"' in made
