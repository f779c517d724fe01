"""Dots of single sessions: as many sessions are as many dots."""

from __future__ import annotations

import pytest

from app.platform.web.charts import apart_where_equal, side_by_side


def test_six_sessions_with_one_value_are_six_dots() -> None:
    places = side_by_side([7.0] * 6, close=0.4, half=0.27, step=0.2)
    assert places == pytest.approx([-0.27, -0.162, -0.054, 0.054, 0.162, 0.27])
    assert side_by_side([7.0, 7.0], 0.4, 0.27, 0.11) == pytest.approx([-0.055, 0.055])


def test_dots_of_about_one_height_stand_beside_each_other_and_others_in_the_middle() -> None:
    assert side_by_side([7.3, 7.0], 0.4, 0.27, 0.11) == pytest.approx([0.055, -0.055])
    assert side_by_side([7.0, 7.5], 0.4, 0.27, 0.11) == [0.0, 0.0]
    assert side_by_side([], 0.4, 0.27, 0.11) == []


def test_equal_points_of_a_plane_stand_beside_their_place_and_others_stay() -> None:
    assert apart_where_equal([(1.0, 7.0), (2.0, 7.0), (1.0, 7.0)], step=0.1) == pytest.approx([0.95, 2.0, 1.05])
