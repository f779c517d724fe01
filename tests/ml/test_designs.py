"""Exploration designs: densities in closed form, exact stratification, safety limits for all seeds, recognition of sustained draws."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import kstest

from ml.designs import (
    HOLD_SECONDS,
    LOW_AMPLITUDE,
    LOW_SECONDS,
    NEAR_SPREAD,
    SPREAD,
    Bound,
    DesignSettings,
    DrawDensity,
    hold_steps,
    lay_out,
    near_density,
    near_doses,
    near_session,
    recognise,
    stratified_levels,
)

seeds = st.integers(0, 2**32 - 1)
bounds = st.floats(0.0, 0.95)


def stratified(**changes):
    return DesignSettings(**{"visits": 3, "sessions": 4, "steps": 300, **changes})


@given(seed=seeds, bound=bounds, visits=st.integers(1, 6), sessions=st.integers(1, 6), steps=st.integers(1, 600), ladder=st.booleans())
def test_no_step_is_below_the_bound_and_low_ones_end_after_five_minutes(seed, bound, visits, sessions, steps, ladder):
    designed = lay_out(stratified(seed=seed, bound=Bound(bound), visits=visits, sessions=sessions, steps=steps, ladder=ladder))
    assert [(s.visit, s.number) for s in designed] == [(v, n) for v in range(1, visits + 1) for n in range(sessions)]
    for session in designed:
        a = session.amplitudes
        assert a.min() >= bound
        assert a.max() <= 1
        assert 2.0 * np.sum(a < LOW_AMPLITUDE) <= LOW_SECONDS
        assert session.level is None or bound <= session.level <= 1
        assert a.size == steps
        if session.design in ("stratified", "ladder"):
            assert np.all(np.flatnonzero(a < LOW_AMPLITUDE) >= steps - LOW_SECONDS / 2.0), "low ones at the end alone"


@given(seed=seeds, bound=bounds, visits=st.integers(1, 6), sessions=st.integers(1, 6), ladder=st.booleans())
def test_levels_are_stratified_exactly_within_and_across_visits(seed, bound, visits, sessions, ladder):
    levels = stratified_levels(stratified(seed=seed, bound=Bound(bound), visits=visits, sessions=sessions, ladder=ladder))
    own = sessions - ladder
    assert levels.shape == (visits, own)
    unit = (levels - bound) / (1 - bound)
    if own:
        assert sorted(np.floor(unit * visits * own + 1e-9 * (unit < 1)).astype(int).ravel()) == list(range(visits * own))
        for row in unit:
            assert sorted(np.floor(row * own + 1e-9 * (row < 1)).astype(int)) == list(range(own))


def test_each_single_level_is_uniform_over_seeds():
    levels = np.array([stratified_levels(stratified(seed=k))[1, 2] for k in range(2000)])
    assert kstest((levels - 0.3) / 0.7, "uniform").pvalue > 0.01


@given(level=st.floats(0, 1), low=bounds)
def test_the_density_of_draws_integrates_to_one(level, low):
    law = DrawDensity(level, low)
    near = law.near
    edges = np.unique([low, *near, 1.0])
    total = sum(quad(law.density, a + 1e-12, b - 1e-12)[0] for a, b in pairwise(edges) if b - a > 1e-9)
    assert total == pytest.approx(1.0, abs=1e-6)
    assert law.density(low - 1e-6) == 0
    assert law.density(1 + 1e-6) == 0


def test_draws_follow_their_density():
    law, rng = DrawDensity(0.5, 0.3), np.random.default_rng(1)
    drawn = np.array([law.draw(rng) for _ in range(20_000)])
    low, high = law.near
    assert (low, high) == (0.5 - SPREAD, 0.5 + SPREAD)
    inside = quad(law.density, low, high)[0]
    assert np.mean((drawn >= low) & (drawn <= high)) == pytest.approx(inside, abs=0.015)
    assert np.mean(drawn > 0.9) == pytest.approx(quad(law.density, 0.9, 1.0)[0], abs=0.01)


def test_logged_densities_are_those_of_the_bound_in_force():
    for session in lay_out(stratified(seed=5)):
        for d in session.decisions:
            # the last 150 of 300 steps of 2 s may be low
            law = DrawDensity(session.level, 0.3 if d.start >= 150 else LOW_AMPLITUDE)
            assert d.log_density == pytest.approx(float(np.log(law.density(d.amplitude))))
            assert d.start >= 150 or d.start + d.steps <= 150


def test_holds_are_log_uniform():
    rng = np.random.default_rng(0)
    seconds = 0.01 * np.array([hold_steps(rng, 0.01) for _ in range(3000)])
    low, high = HOLD_SECONDS
    assert seconds.min() >= low - 0.01
    assert seconds.max() <= high + 0.01
    assert kstest(np.log(seconds / low) / np.log(high / low), "uniform").pvalue > 0.01


def test_decisions_have_no_gaps():
    for session in lay_out(stratified(seed=2, ladder=True)):
        starts = np.cumsum([0, *(d.steps for d in session.decisions)])
        assert [d.start for d in session.decisions] == list(starts[:-1])


def test_the_papers_design_draws_every_step_uniformly():
    designed = lay_out(stratified(name="paper", visits=4, sessions=6, seed=3))
    drawn = np.concatenate([s.amplitudes for s in designed])
    assert all(d.steps == 1 and d.log_density == pytest.approx(-np.log(0.7)) for s in designed for d in s.decisions)
    assert kstest((drawn - 0.3) / 0.7, "uniform").pvalue > 0.01
    assert all(s.level is None and s.design == "paper" for s in designed)


def test_sustained_doses_are_tried_by_the_stratified_design_and_not_by_the_papers():
    def widest(name):
        designed = lay_out(stratified(name=name, seed=4))
        return np.ptp([s.amplitudes[-150:].mean() for s in designed])

    assert widest("paper") < 0.1
    assert widest("stratified") > 0.4


@pytest.mark.parametrize(("bound", "rungs"), [(0.3, [1, 0.8, 0.6, 0.4]), (0.5, [1, 0.8, 0.6]), (0.0, [1, 0.8, 0.6, 0.4, 0.2]), (0.85, [1])])
def test_the_ladder_goes_down_by_fifths_to_the_bound_or_the_limit(bound, rungs):
    session = lay_out(stratified(bound=Bound(bound), ladder=True))[0]
    assert session.design == "ladder"
    assert [d.amplitude for d in session.decisions] == pytest.approx(rungs)
    assert all(d.log_density is None for d in session.decisions)
    assert [d.steps for d in session.decisions] == [300 - 60 * (len(rungs) - 1), *[60] * (len(rungs) - 1)], "it ends with the session"


@pytest.mark.parametrize(("minutes", "rungs"), [(1, [1]), (5, [1, 0.8]), (7, [1, 0.8, 0.6]), (20, [1, 0.8, 0.6, 0.4])])
def test_a_ladder_takes_the_rungs_that_a_session_has_time_for(minutes, rungs):
    session = lay_out(stratified(ladder=True, steps=30 * minutes))[0]
    assert [d.amplitude for d in session.decisions] == pytest.approx(rungs)
    assert session.amplitudes.size == 30 * minutes


def test_the_same_seed_gives_the_same_design_and_another_one_another():
    first, again, other = (lay_out(stratified(seed=s)) for s in (7, 7, 8))
    assert first == again
    assert first != other


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"visits": 0}, "visits"),
        ({"period_s": 0.0}, "period_s"),
        ({"name": "held"}, "no design 'held'"),
        ({"name": "paper", "ladder": True}, "ladder"),
    ],
)
def test_settings_outside_their_range_are_refused_by_name(changes, words):
    with pytest.raises(ValueError, match=words):
        stratified(**changes)


@given(seed=seeds, resolution=st.sampled_from([0.0, 1 / 30, 1 / 20]))
def test_held_draws_are_recognised_in_rounded_logs(seed, resolution):
    def logged(session):
        return np.round(session.amplitudes / resolution) * resolution if resolution else session.amplitudes

    settings = {"seed": seed, "visits": 1, "sessions": 1}
    (held,), (paper,) = lay_out(stratified(**settings)), lay_out(stratified(name="paper", **settings))
    assert recognise(logged(held)).kind == "held"
    assert recognise(logged(paper)).kind == "every_step"


def test_recognised_holds_are_those_of_the_design_and_end_at_gaps():
    (session,) = lay_out(stratified(visits=1, sessions=1, seed=9))
    found = recognise(session.amplitudes)
    assert [(s, n) for s, n, _ in found.holds] == [(d.start, d.steps) for d in session.decisions]
    gap = recognise([0.5, 0.5, np.nan, 0.5, 0.7] + [0.7] * 10)
    assert gap.holds == ((0, 2, 0.5), (3, 1, 0.5), (4, 11, 0.7))


def test_constant_and_too_short_sessions_are_neither():
    assert recognise([0.5] * 20).kind == "constant"
    assert recognise([0.5, 0.6]).kind == "unknown"
    assert recognise([]).kind == "unknown"
    assert recognise([np.nan] * 30).kind == "unknown"


@given(seed=seeds, bound=st.floats(0.0, 0.9), place=st.floats(0.0, 0.99), steps=st.integers(1, 600))
def test_a_session_near_an_amplitude_stays_near_it_within_the_rules_of_safety(seed, bound, place, steps):
    level = bound + place * (1 - bound)
    session = near_session(level, steps, 2.0, Bound(bound), seed, 0)
    assert (session.design, session.level, session.seed) == ("near", level, seed)
    a = session.amplitudes
    assert a.size == steps
    assert a.min() >= bound
    assert a.max() <= 1
    low = np.flatnonzero(a < LOW_AMPLITUDE)
    assert low.size * 2.0 <= LOW_SECONDS
    assert low.size == 0 or low.min() >= steps - LOW_SECONDS / 2.0
    late = a[-int(min(steps, LOW_SECONDS / 2.0)) :]
    assert np.abs(late - level).max() <= NEAR_SPREAD + 1e-12
    for d in session.decisions:
        law = near_density(level, max(bound, LOW_AMPLITUDE) if d.start < steps - LOW_SECONDS / 2.0 else bound)
        assert d.log_density == pytest.approx(float(np.log(law.density(d.amplitude))))


@pytest.mark.parametrize(("level", "low"), [(0.7, 0.3), (0.3, 0.3), (0.98, 0.6), (0.4, 0.6)])
def test_the_density_near_an_amplitude_integrates_to_one_and_is_that_of_the_draws(level, low):
    law = near_density(level, low)
    assert quad(law.density, *law.near)[0] == pytest.approx(1.0)
    assert law.density(law.near[0] - 0.01) == law.density(law.near[1] + 0.01) == 0
    rng = np.random.default_rng(0)
    first, last = law.near
    assert kstest([law.draw(rng) for _ in range(500)], "uniform", args=(first, last - first)).pvalue > 0.001


@pytest.mark.parametrize("level", [0.4, 0.55, 0.62, 0.8, 0.97])
def test_the_dose_of_a_session_near_an_amplitude_is_the_mean_of_many(level):
    runs = np.stack([near_session(level, 300, 2.0, Bound(0.3), seed, 0).amplitudes for seed in range(300)])
    mean, late = near_doses(level, 300, 2.0, Bound(0.3))
    assert runs.mean() == pytest.approx(mean, abs=0.003)
    assert runs[:, -150:].mean() == pytest.approx(late, abs=0.003)


@pytest.mark.parametrize("level", [0.29, 1.0])
def test_no_session_is_held_below_the_bound_or_at_cdbs(level):
    with pytest.raises(ValueError, match="held near"):
        near_session(level, 300, 2.0, Bound(0.3), 1, 0)


@pytest.mark.parametrize("fraction", [-0.1, 1.0, float("nan")])
def test_a_lower_bound_is_a_fraction_below_cdbs(fraction):
    with pytest.raises(ValueError, match="lower bound"):
        Bound(fraction)


def test_a_lower_bound_allows_levels_from_itself_to_below_cdbs_and_counts_steps_of_a_device():
    bound = Bound(0.45)
    assert [bound.allows(level) for level in (0.44, 0.45, 0.99, 1.0)] == [False, True, True, False]
    assert (bound.early_lowest, Bound(0.7).early_lowest) == (0.6, 0.7)
    assert bound.amplitudes(np.array([0.0, 0.5, 1.0])).tolist() == pytest.approx([0.45, 0.725, 1.0])
    # of 3 mA in steps of 0.1: 1.35 mA needs 14 steps; 0.3 * 3 = 0.9 mA is nine, whatever floating point makes of it
    assert (bound.steps(0.1 / 3), Bound(0.3).steps(0.1 / 3)) == (14, 9)
