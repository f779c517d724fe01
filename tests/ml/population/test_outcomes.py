from __future__ import annotations

import numpy as np
import pytest

from ml.population import PARTICIPANTS
from ml.population.outcomes import measure, minute_seconds, tremor_minutes
from ml.population.physiology.brain import seed_streams
from ml.qoc import grasp_frequency, tremor_percent


def test_tremor_minutes_class_the_mean_of_30_steps_and_of_what_is_left():
    severity = np.concatenate([np.full(30, 0.29), np.full(30, 1.0), np.full(15, 0.0), np.full(15, 1.9), np.full(10, 5.0)])
    assert tremor_minutes(severity) == ("none", "mild", "slight", "strong")
    assert minute_seconds(("none", "mild", "slight", "strong"), 100) == {"none": 60, "mild": 60, "slight": 60, "strong": 20}


def test_qocs_follow_the_papers_formulas_over_what_was_measured(constant_sessions):
    batch = constant_sessions("P3", 0.25)
    for i in range(len(batch)):
        session = batch.session(i)
        assert session.qoc.grasp_hz == grasp_frequency(session.outcomes.open_fist_s)
        seconds = minute_seconds(session.outcomes.tremor_minutes, session.steps)
        assert session.qoc.tremor_percent == tremor_percent(seconds, 2.0 * session.steps)
        assert session.outcomes.open_fist_s[-1] <= 10
        assert np.all(np.diff(session.outcomes.open_fist_s) > 0.08)
        assert session.qoc.rating in range(1, 11)


@pytest.mark.slow
def test_more_stimulation_means_faster_grasps_and_less_tremor(constant_sessions):
    for code in ("P1", "P2", "P3", "P4"):
        grasps = [np.mean([o.qoc.grasp_hz for o in constant_sessions(code, a).outcomes]) for a in (0, 0.25, 0.5, 1)]
        assert np.all(np.diff(grasps) > 0), (code, grasps)
        tremor = [np.mean([o.qoc.tremor_percent for o in constant_sessions(code, a).outcomes]) for a in (0, 0.5, 1)]
        assert tremor[0] > tremor[2]


def test_a_rating_falls_by_the_mean_change_of_amplitude():
    flat, jumping = np.full(100, 0.7), np.tile([0.4, 1.0], 50)
    brady, none = np.full(100, 0.5), np.zeros(100)
    ratings = []
    for amplitude in (flat, jumping):
        counters = seed_streams(np.arange(400, dtype=np.uint64), np.ones(400, dtype=np.uint64))
        ratings.append(np.mean([measure(PARTICIPANTS["P1"], row, amplitude, brady, none, none).qoc.rating for row in counters]))
    assert ratings[0] == pytest.approx(9 - 3 * 0.5, abs=0.1)
    assert ratings[0] - ratings[1] == pytest.approx(0.6, abs=0.1)


def test_overload_and_tremor_lower_the_rating_to_no_less_than_1():
    counters = seed_streams(np.arange(2, dtype=np.uint64), np.ones(2, dtype=np.uint64))
    calm, bad = np.zeros(30), np.full(30, 5.0)
    assert measure(PARTICIPANTS["P4"], counters[0], calm, calm, calm, calm).qoc.rating >= 8
    assert measure(PARTICIPANTS["P4"], counters[1], calm, np.ones(30), bad, bad).qoc.rating == 1
