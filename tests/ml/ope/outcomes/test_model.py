"""Outcomes of sessions: dose shapes, levels of visits, severity, missing and failed outcomes, and r_end as the sum of its parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit

from ml.mdp import MdpSettings
from ml.ope.outcomes.minutes import Minutes, by_minute
from ml.ope.outcomes.model import fit_end_model
from ml.qoc import Qoc, failed_qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory

W, T = 10, 60
SETTINGS = MdpSettings(xi_beta=2.0, c2=10.0, c3=0.0, c4=0.0)
ALL = replace(SETTINGS, c2=10.0, c3=5.0, c4=20.0)


def buffer_of(doses, grasps, visits, tremors=None, settings=SETTINGS, ratings=None, steps=T):
    """Build sessions of constant (or given) amplitudes; a missing value is NaN."""
    sessions = []
    for i, (dose, visit) in enumerate(zip(doses, visits, strict=True)):
        known = {"grasp_hz": grasps[i]}
        known |= {} if ratings is None else {"rating": ratings[i]}
        known |= {} if tremors is None else {"tremor_percent": tremors[i]}
        qoc = Qoc(**{name: None if np.isnan(v) else int(v) if name == "rating" else float(v) for name, v in known.items()})
        a = np.full(steps, dose) if np.ndim(dose) == 0 else np.asarray(dose)
        sessions.append(SessionTrajectory(i, int(visit), "other", np.full(W, 1.0), np.full(steps, 1.0), a, qoc=qoc))
    return ReplayBuffer(settings, tuple(sessions), "uV", "table")


def at(*doses, steps=T):
    return by_minute(np.full((len(doses), steps), 1.0), np.array(doses)[:, None] * np.ones(steps), SETTINGS)


def slope(model, low=0.5, high=0.9):
    found = model.predict(at(low, high))[:, 1]
    return float((found[1] - found[0]) / (high - low))


def test_a_good_day_is_not_taken_for_a_good_amplitude():
    # Low amplitudes were tried on two good days, high ones on two bad days; within a day more amplitude is better.
    rng = np.random.default_rng(0)
    visits = np.repeat([1, 2, 3, 4], 6)
    doses = np.where(visits <= 2, 0.45, 0.85) + np.tile([-0.1, -0.06, -0.02, 0.02, 0.06, 0.1], 4)
    grasps = 2.0 + 1.0 * doses + np.where(visits <= 2, 0.6, -0.6) + 0.02 * rng.standard_normal(24)
    assert np.polyfit(doses, grasps, 1)[0] < -1.0
    model = fit_end_model(buffer_of(doses, grasps, visits))
    assert slope(model) == pytest.approx(1.0, abs=0.3)
    assert model.day_share[1] > 0.8


def test_a_controller_that_gives_more_in_bad_hours_does_not_hide_what_the_amplitude_does():
    rng = np.random.default_rng(1)
    n = 40
    severity = rng.standard_normal(n)
    follows = np.arange(n) % 3 > 0
    doses = np.where(follows, np.clip(0.65 + 0.12 * severity, 0.0, 1.0), rng.choice([0.5, 0.65, 1.0], n))
    grasps = 1.5 + 1.0 * doses - 0.5 * severity + 0.05 * rng.standard_normal(n)
    buffer = buffer_of(doses, grasps, np.arange(n) // 8)
    confounded, adjusted = fit_end_model(buffer), fit_end_model(buffer, severity=severity, draws=300, seed=2)
    assert slope(confounded) < 0.4
    assert slope(adjusted) == pytest.approx(1.0, abs=0.25)
    ends = adjusted.each(Minutes(*(v[None] for v in vars(at(0.5, 0.9)).values())))[..., 1]
    slopes = (ends[:, 1] - ends[:, 0]) / 0.4
    assert np.quantile(slopes, 0.05) < 1.0 < np.quantile(slopes, 0.95)


def test_r_end_is_that_of_the_predicted_outcomes_and_each_stays_within_its_range():
    doses = np.linspace(0.1, 1.0, 16)
    tremors, ratings = np.clip(120 * (1 - doses), 0, 100), np.clip(np.round(14 * doses), 1, 10)
    model = fit_end_model(buffer_of(doses, 1 + doses, np.arange(16) // 4, tremors, ALL, ratings))
    found = model.predict(at(0.0, 0.5, 1.0))
    np.testing.assert_allclose(found[:, 0], 10 * found[:, 1] + 5 * found[:, 2] - 20 * found[:, 3] / 100)
    assert (found[:, 2] >= 1).all()
    assert (found[:, 2] <= 10).all()
    assert 60 < found[0, 3] <= 100
    assert found[0, 2] < 2 < 9 < found[2, 2]


def test_tremor_that_returns_below_a_dose_is_known_from_minutes_at_that_dose_and_not_from_means():
    # Ten minutes, the last four at a lower dose: tremor in those minutes where the dose is below 0.5. A straight line through session means
    # gives a constant of 0.45 about half of the minutes; by minutes it has tremor throughout.
    rng = np.random.default_rng(5)
    steps, doses, tremors = 300, [], []
    for k in range(24):
        late = (1.0, 0.8, 0.7, 0.6, 0.4, 0.3)[k % 6]
        a = np.concatenate([np.full(180, 0.7), np.full(120, late)])
        minutes = a.reshape(10, 30).mean(1) + 0.02 * rng.standard_normal(10)
        doses.append(a)
        tremors.append(10.0 * int((minutes < 0.5).sum()))
    settings = replace(SETTINGS, c4=10.0)
    model = fit_end_model(buffer_of(doses, np.full(24, 2.0), np.arange(24) // 6, tremors, settings, steps=steps))
    low, middle, high = model.predict(at(0.35, 0.65, 0.9, steps=steps))[:, 3]
    assert np.polyfit([a.mean() for a in doses], tremors, 1) @ [0.35, 1.0] < 80
    assert low > 85
    assert middle < 20
    assert high < 10


def test_a_session_without_one_qoc_still_counts_for_the_others():
    rng = np.random.default_rng(6)
    doses = np.tile([0.2, 0.5, 0.8, 1.0], 6)
    grasps, ratings, tremors = 1 + doses, np.round(2 + 7 * doses), 100 * expit(8 * (0.5 - doses))
    whole = buffer_of(doses, grasps + 0.05 * rng.standard_normal(24), np.arange(24) // 6, tremors, ALL, ratings)
    sessions = list(whole.sessions)
    for i in range(24):  # each session lacks one of the three: not one of them has an r_end
        lost = ("grasp_hz", "rating", "tremor_percent")[i % 3]
        sessions[i] = replace(sessions[i], qoc=replace(sessions[i].qoc, **{lost: None}))
    patchy = fit_end_model(replace(whole, sessions=tuple(sessions)))
    assert patchy.seen == (True, True, True, True)
    np.testing.assert_allclose(patchy.predict(at(0.3, 0.9))[:, 0], fit_end_model(whole).predict(at(0.3, 0.9))[:, 0], atol=6.0)


def test_an_outcome_that_counts_and_was_never_measured_leaves_r_end_unseen():
    settings = replace(SETTINGS, c4=10.0)
    model = fit_end_model(buffer_of([0.4, 0.6, 0.8, 1.0], [1.4, 1.6, 1.8, 2.0], [1, 1, 2, 2], None, settings, [7.0] * 4))
    assert model.seen == (False, True, True, False)


def test_where_no_qoc_counts_r_end_is_zero_and_the_qocs_are_predicted_all_the_same():
    nothing = replace(SETTINGS, c2=0.0)
    doses = np.tile([0.4, 0.7, 1.0], 4)
    model = fit_end_model(buffer_of(doses, 1 + doses, np.arange(12) // 4, settings=nothing), draws=20)
    found = model.predict(at(0.5, 1.0))
    assert model.seen == (True, True, False, False)
    assert (found[:, 0] == 0).all()
    assert found[1, 1] > found[0, 1] + 0.2
    bare = fit_end_model(buffer_of(doses, np.full(12, np.nan), np.arange(12) // 4, settings=nothing))
    assert bare.seen[0]
    assert bare.predict(at(0.5))[0, 0] == 0


def test_without_sessions_of_different_amplitude_the_draws_say_that_its_effect_is_not_known():
    rng = np.random.default_rng(3)
    doses = 0.65 + 0.01 * rng.standard_normal(18)
    grasps = 2.0 + 0.2 * rng.standard_normal(18)
    drawn = fit_end_model(buffer_of(doses, grasps, np.arange(18) // 6), draws=200, seed=0)
    ends = drawn.each(Minutes(*(v[None] for v in vars(at(0.1, 0.65)).values())))[..., 1]
    assert ends[:, 0].std() > 2.5 * ends[:, 1].std()


def test_draws_are_the_same_for_all_policies_so_that_differences_are_surer_than_levels():
    rng = np.random.default_rng(8)
    doses = np.tile([0.4, 0.6, 0.8, 1.0], 6)
    ratings = np.clip(np.round(3 + 5 * doses + np.repeat(rng.standard_normal(4), 6)), 1, 10)
    model = fit_end_model(buffer_of(doses, np.full(24, 2.0), np.arange(24) // 6, None, replace(SETTINGS, c3=10.0), ratings), draws=200)
    ends = model.each(Minutes(*(v[None] for v in vars(at(0.75, 0.8)).values())))[..., 2]
    assert (ends[:, 1] - ends[:, 0]).std() < 0.3 * ends[:, 0].std()
    again = fit_end_model(buffer_of(doses, np.full(24, 2.0), np.arange(24) // 6, None, replace(SETTINGS, c3=10.0), ratings), draws=200)
    np.testing.assert_array_equal(again.each(Minutes(*(v[None] for v in vars(at(0.75, 0.8)).values())))[..., 2], ends)
    with pytest.raises(ValueError, match="outcome model of 200"):
        model.each(Minutes(*(np.repeat(v[None], 3, axis=0) for v in vars(at(0.75)).values())))


def test_what_a_session_had_of_its_own_stays_with_it_within_the_range_and_without_bias():
    model = fit_end_model(buffer_of([0.5] * 6, [1.0] * 6, np.arange(6) // 3, [50.0] * 6))
    known = np.array([[0.0, 1.0, 7.0, 100.0]] * 2 + [[0.0, 2.0, 7.0, 0.0]] * 6)  # tremor 25 % on average
    seen, now = np.tile([0.0, 1.5, 7.0, 25.0], (8, 1)), np.tile([0.0, 1.2, 8.5, 5.0], (8, 1))
    moved = model.carried(now, known, seen)
    np.testing.assert_allclose(moved[:, 3], [20.0] * 2 + [0.0] * 6)  # their mean is 5, with a plain sum cut at 0 it would be 20
    np.testing.assert_allclose(moved[:, 2], 8.5)
    np.testing.assert_allclose(moved[:2, 1], 0.8)
    np.testing.assert_allclose(model.carried(seen, known, seen)[:, 1:], known[:, 1:])
    unknown = np.full((8, 4), np.nan)
    np.testing.assert_allclose(model.carried(now, unknown, seen)[:, 1:], now[:, 1:])


def test_a_stopped_session_is_a_failure_of_what_ran_and_never_a_missing_one():
    doses = np.tile([0.5, 0.6, 0.9, 1.0], 5)
    ratings = np.full(20, 8.0)
    whole = buffer_of(doses, np.full(20, 2.0), np.arange(20) // 4, np.zeros(20), ALL, ratings)
    worst = failed_qoc(s.qoc for s in whole.sessions)
    failed = tuple(replace(s, stopped_as=worst, qoc=Qoc()) if s.amplitude[0] == 0.5 and s.visit < 3 else s for s in whole.sessions)
    stopped = fit_end_model(replace(whole, sessions=failed))
    missing = fit_end_model(replace(whole, sessions=tuple(replace(s, stopped_as=None) for s in failed)))
    before, after = missing.predict(at(0.5, 1.0))[:, 0], stopped.predict(at(0.5, 1.0))[:, 0]
    assert before[0] == pytest.approx(before[1], abs=3)
    assert after[0] < after[1] - 10


def test_draws_are_spread_as_far_as_asked_around_the_same_mean():
    rng = np.random.default_rng(9)
    doses = np.tile([0.4, 0.6, 0.8, 1.0], 6)
    buffer = buffer_of(doses, 1 + doses + 0.1 * rng.standard_normal(24), np.arange(24) // 6)
    narrow, wide = (fit_end_model(buffer, draws=400, wider=factor) for factor in (1.0, 1.4))
    seen = Minutes(*(v[None] for v in vars(at(0.3)).values()))
    one, other = (m.each(seen)[:, 0, 1] for m in (narrow, wide))
    assert 1.15 < other.std() / one.std() < 1.5  # shapes are drawn alike
    assert other.mean() == pytest.approx(one.mean(), abs=0.05)
    np.testing.assert_array_equal(narrow.predict(at(0.3)), wide.predict(at(0.3)))
