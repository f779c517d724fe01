"""Outcomes by the time since the last dose of medication: adjusted for where it is known, and moved by no policy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.ope.outcomes.medication import WIDTH_H, WORN_OFF_H, worn_off
from ml.ope.outcomes.model import fit_end_model
from tests.ml.ope.outcomes.test_model import at, buffer_of, slope

EARLY, LATE = WORN_OFF_H


def told(buffer, hours):
    sessions = zip(buffer.sessions, hours, strict=True)
    return replace(buffer, sessions=tuple(replace(s, medication_h=None if np.isnan(h) else float(h)) for s, h in sessions))


def visit_by_visit(rng, worn_grasp=-0.4):
    """Simulate four visits of six sessions; low doses come late, when medication has worn off. [24] each: doses, grasps, visits, hours."""
    hours = np.tile([0.5, 1.0, 1.5, 2.5, 3.0, 3.5], 4)
    doses = np.tile([1.0, 0.7, 0.9, 0.5, 0.8, 0.3], 4) + 0.05 * rng.standard_normal(24)
    grasps = 1.5 + 0.5 * doses + worn_grasp / (1 + np.exp(-(hours - 2.0) / WIDTH_H)) + 0.05 * rng.standard_normal(24)
    return doses, grasps, np.arange(24) // 6, hours


def test_a_session_that_does_not_know_the_time_is_taken_for_the_mean_of_those_that_do():
    hours = np.array([0.5, 1.0, 2.0, np.nan, 3.0, 4.0, 5.0, np.nan])
    found = worn_off(told(buffer_of(np.ones(8), np.ones(8), np.zeros(8)), hours))
    assert set(found) == {EARLY, LATE}
    known = np.isfinite(hours)
    for name, column in found.items():
        worn = 1 / (1 + np.exp(-(hours[known] - WORN_OFF_H[name]) / WIDTH_H))
        np.testing.assert_allclose(column[known], worn - worn.mean())
        np.testing.assert_array_equal(column[~known], 0)


@pytest.mark.parametrize(
    "hours",
    [
        [0.5, 1.0, 2.0, 3.0, 4.0, *[np.nan] * 3],  # five know it
        [0.5, 1.0, 2.0, 3.0, 4.0, 5.0, *[np.nan] * 7],  # less than half
        [12.0, 13.0, 14.0, 15.0, 16.0, 17.0, 18.0],  # worn off in all of them
    ],
)
def test_nothing_is_adjusted_where_the_times_tell_nothing(hours):
    n = len(hours)
    assert worn_off(told(buffer_of(np.ones(n), np.ones(n), np.zeros(n)), hours)) == {}


def test_low_doses_that_come_late_are_not_blamed_for_medication_that_has_worn_off():
    doses, grasps, visits, hours = visit_by_visit(np.random.default_rng(0))
    buffer = buffer_of(doses, grasps, visits)
    assert slope(fit_end_model(buffer)) > 0.8
    assert slope(fit_end_model(told(buffer, hours))) == pytest.approx(0.5, abs=0.2)


def test_a_session_keeps_how_far_medication_has_worn_off_and_a_new_day_has_the_mean():
    doses, grasps, visits, hours = visit_by_visit(np.random.default_rng(1))
    model = fit_end_model(told(buffer_of(doses, grasps, visits), hours))
    same = model.predict(at(*np.full(24, 0.8)), model.sessions)[:, 1].reshape(4, 6).mean(0)
    assert same[:3].mean() - same[3:].mean() > 0.2
    assert same[3:].mean() < model.predict(at(0.8))[0, 1] < same[:3].mean()
