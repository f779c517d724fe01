"""Delivered dose and time of sessions that are written with a known truth: never wrong without a word."""

from __future__ import annotations

import pytest

from benchmarks.delivered_dose import run
from ml.formats.writers import Course

HARD = {
    "rcs": (11, 17, 65, 95, 123, 163, 172),
    "percept": (2,),
}
"""Seeds of sessions that a decoder was wrong about: a log lost between readings that agree, a clock set back, no settings."""


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
    assert course.range_within(1.0, 4.0) == (2.0, 2.0)
    assert course.range_within(4.0, 11.0) == (0.0, 3.0)
