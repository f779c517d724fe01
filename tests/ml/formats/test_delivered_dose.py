"""Delivered dose and time of sessions that are written with a known truth: never wrong without a word."""

from __future__ import annotations

import pytest

from benchmarks.delivered_dose import run
from ml.formats.writers import Course

HARD = {
    "rcs": (11, 17, 65, 95, 123, 163, 172, 265, 339, 633, 694, 932),
    "percept": (2, 979),
}
"""Seeds of sessions that a decoder was wrong about: a log lost between readings that agree, or no settings.

Others have a clock that was set back, among lost packets or within the first ones, or runs whose clock is unknown.
"""


@pytest.mark.parametrize("kind", ["rcs", "percept"])
def test_no_amplitude_and_no_start_is_wrong_without_a_word(kind: str) -> None:
    score = run(kind, range(20))
    assert (score.wrong, score.shifted, score.silent, score.unreadable) == (0, 0, 0, 0), score.faults
    assert score.usable >= 0.85 * score.knowable
    assert score.knowable > 300


@pytest.mark.parametrize(("kind", "seed"), [(kind, seed) for kind, seeds in HARD.items() for seed in seeds])
def test_a_session_that_was_once_wrong_stays_right(kind: str, seed: int) -> None:
    score = run(kind, range(seed, seed + 1))
    assert (score.wrong, score.shifted, score.silent) == (0, 0, 0), score.faults


def test_a_course_that_cycles_is_off_between_its_pulses() -> None:
    course = Course([-1.0, 10.0], [2.0, 3.0], (5.0, 5.0, 0.0))
    assert [course.level_at(t) for t in (0.0, 4.9, 5.0, 9.9, 10.0, 15.0)] == [2.0, 2.0, 0.0, 0.0, 3.0, 0.0]
    assert course.means_within(1.0, 3.0, (0.0, 0.0), 1.0) == (2.0, 2.0)
    assert course.means_within(4.0, 6.0, (0.0, 0.0), 1.0) == (1.0, 1.0)
    assert course.means_within(4.0, 6.0, (0.0, 0.0), 0.5) == (0.0, 2.0)


def test_a_mean_may_differ_by_what_a_change_may_be_shown_too_early_or_too_late() -> None:
    course = Course([-1.0, 11.0], [1.0, 3.0])
    assert course.means_within(10.0, 12.0, (0.0, 0.0), 1.0) == pytest.approx((2.0, 2.0))
    assert course.means_within(10.0, 12.0, (0.5, 0.0), 1.0) == pytest.approx((2.0, 2.5))
    assert course.means_within(10.0, 12.0, (0.0, 0.1), 1.0) == pytest.approx((1.9, 2.0))
    assert course.means_within(12.0, 14.0, (0.5, 0.1), 0.7) == pytest.approx((3.0, 3.0))
