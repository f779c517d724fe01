"""The virtual population: the compiled kernel against the equations, sessions alone and together, closed forms, worlds and their truth."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from ml.mdp import MdpSettings, end_reward, end_rewards
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.population.virtual import (
    MECHANISMS,
    RATINGS,
    TRAITS,
    WORLDS_PER_PART,
    Mean,
    RelayPolicy,
    draw_patient,
    is_responder,
    new_days,
    simulate,
    visit_days,
    with_trait,
    world,
)
from ml.population.virtual.equations import dose
from ml.population.virtual.patient import HILL, LINE, THRESHOLD, U_SHAPE, measured_qocs
from ml.population.virtual.world import make_up, visit_plan
from ml.qoc import Qoc, tremor_percent

FIELDS = ("lead", "beta", "amplitude", "brady", "tremor", "overload")
FOLLOWING = ProportionalPolicy(0.6, 1.8, 0.2, 3)


def test_sessions_say_the_time_since_a_dose_that_wears_off_two_to_four_hours_after_it():
    told = [world("A", index) for index in range(WORLDS_PER_PART)]
    taking = [w for w in told if w.patient.med_need > 0]
    assert 0 < len(taking) < len(told)
    assert all(w.medication_h(0.0) is None for w in told if w not in taking)
    for w in taking:
        assert 2.0 <= w.medication_h(w.patient.med_off_h) <= 4.0
        assert w.medication_h(1.5) - w.medication_h(0.5) == pytest.approx(1.0)
    hours = [s.medication_h for s in taking[0].data("paper").sessions]
    assert hours[:2] == [taking[0].medication_h(0.0), taking[0].medication_h(1 / 3)]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", range(len(MECHANISMS)))
def test_the_kernel_gives_the_numbers_of_the_equations(kind, seed):
    rng = np.random.default_rng([kind, seed])
    trait = [None, *TRAITS][(kind + 2 * seed) % 9]
    patient = with_trait(draw_patient(kind, rng), trait, rng)
    days = new_days(3, 0, 6)
    fast, read = (simulate(patient, 1.2, FOLLOWING, days=days, key=3, steps=120, readable=r) for r in (False, True))
    for field in FIELDS:
        np.testing.assert_allclose(getattr(fast, field), getattr(read, field), rtol=1e-9, atol=1e-9, err_msg=field)
    for name, values in fast.qocs.items():
        np.testing.assert_allclose(values, read.qocs[name], rtol=1e-9, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("kind", range(len(MECHANISMS)))
def test_a_session_is_the_same_alone_in_a_batch_and_at_its_beginning(kind):
    patient, days = draw_patient(kind, np.random.default_rng(kind)), new_days(4, 0, 5)
    together = simulate(patient, 1.0, FOLLOWING, days=days, key=4, steps=60)
    alone = simulate(patient, 1.0, FOLLOWING, days=new_days(4, 3, 1), key=4, first=3, steps=60)
    longer = simulate(patient, 1.0, FOLLOWING, days=days, key=4, steps=90)
    np.testing.assert_array_equal(together.beta[3], alone.beta[0])
    np.testing.assert_array_equal(together.beta, longer.beta[:, :60])
    assert together.qocs["rating"][3] == alone.qocs["rating"][0]


@pytest.mark.parametrize("shape", [LINE, HILL, THRESHOLD])
def test_dose_responses_rise_from_zero_to_one(shape):
    a = np.linspace(0, 1, 101)
    d = dose(shape, a, np.full(101, 0.5), 3.0)
    assert d[0] == pytest.approx(0, abs=1e-12)
    assert d[-1] == pytest.approx(1)
    assert np.all(np.diff(d) > 0)


def test_a_u_is_best_at_its_half_and_worse_at_full_amplitude():
    a = np.linspace(0, 1, 101)
    d = dose(U_SHAPE, a, np.full(101, 0.6), 3.0)
    assert a[np.argmax(d)] == pytest.approx(0.6)
    assert d.max() == pytest.approx(1)
    assert d[-1] == pytest.approx(1 - (0.4 / 0.6) ** 2)


def quiet(kind=0, **changes):
    """Build a patient without noise, drift, days and other mechanisms' parts."""
    none = dict.fromkeys(
        ("noise", "drift_sd", "act_beta", "act_half", "act_need", "act_tolerance", "day_level", "day_gain", "day_half", "day_need",
         "session_level", "med_beta", "med_need", "ring_gain"),
        0.0,
    )  # fmt: skip
    base = {"shape": LINE, "unit": 1.0, "log_scale": 1, "depth": 0.5, "immediate": 0.0, "fast": 0.0}
    return draw_patient(kind, np.random.default_rng(0))._replace(**{**none, **base, **changes})


def test_wash_in_and_wash_out_follow_their_own_exponentials():
    patient = quiet(slow_up=0.05, slow_down=0.02)
    asked = np.concatenate([np.full(100, 0.4), np.full(100, 0.9)])[None, :]
    found = simulate(patient, 1.0, asked, days=new_days(1, 0, 1), key=1, steps=200)
    effect = -np.log(found.beta[0]) / 0.5
    k = np.arange(1, 101)
    down = 0.4 + 0.6 * 0.98**k
    np.testing.assert_allclose(effect[:100], down, rtol=1e-10)
    up = 0.9 + (down[-1] - 0.9) * 0.95**k
    np.testing.assert_allclose(effect[100:], up, rtol=1e-10)


def test_dead_time_shifts_the_answer():
    patient = quiet(MECHANISMS.index("delayed"), delay=7, rebound=0.0, immediate=1.0)
    asked = np.concatenate([np.ones(20), np.full(40, 0.2)])[None, :]
    beta = simulate(patient, 1.0, asked, days=new_days(1, 0, 1), key=1, steps=60).beta[0]
    np.testing.assert_allclose(beta[:27], np.exp(-0.5))
    np.testing.assert_allclose(beta[27:], np.exp(-0.1))


def test_a_habit_takes_the_answer_to_a_lasting_dose_away():
    patient = quiet(MECHANISMS.index("tolerance"), habit=1.0, habit_rate=0.1, immediate=1.0)
    asked = np.full((1, 300), 0.5)
    beta = simulate(patient, 1.0, asked, days=new_days(1, 0, 1), key=1, steps=300).beta[0]
    assert beta[0] > 1.1  # at once a lower amplitude lets beta rise
    assert beta[-1] == pytest.approx(1.0, abs=1e-6)


def test_hysteresis_keeps_what_small_changes_leave():
    patient = quiet(MECHANISMS.index("hysteresis"), play=0.2, immediate=1.0)
    asked = np.concatenate([np.full(50, 0.7), np.full(50, 0.9), np.full(50, 0.4)])[None, :]
    beta = simulate(patient, 1.0, asked, days=new_days(1, 0, 1), key=1, steps=150).beta[0]
    # the play operator comes from 0.8, goes to 0.8 = min(0.8, 0.7 + 0.2), stays at 0.9 - 0.2 < 0.8, and falls to 0.4 + 0.2
    np.testing.assert_allclose(beta[49], np.exp(-0.5 * 0.8))
    np.testing.assert_allclose(beta[99], np.exp(-0.5 * 0.8))
    np.testing.assert_allclose(beta[149], np.exp(-0.5 * 0.6))


def test_bursts_last_as_their_rates_say():
    patient = quiet(MECHANISMS.index("bursts"), burst_in=0.1, burst_out=0.1, immediate=1.0)
    found = simulate(patient, 1.0, ConstantPolicy(0.5), days=new_days(2, 0, 400), key=2, steps=300)
    high = found.beta > found.beta.min() * 1.2
    enter, leave = 0.1 * 0.5, 0.1 + 0.45 * 0.5
    assert high[:, 100:].mean() == pytest.approx(enter / (enter + leave), abs=0.01)


def test_activity_and_drift_have_their_stated_spread():
    patient = quiet(drift_sd=0.1, depth=0.0, drift_rate=0.05)
    x = np.log(simulate(patient, 1.0, ConstantPolicy(1.0), days=new_days(5, 0, 2000), key=5, steps=100).beta)
    # an Euler step of rate h has the stationary variance sd^2 2 h / (2 h - h^2)
    assert x[:, -1].std() == pytest.approx(0.1 / np.sqrt(1 - 0.05 / 2), rel=0.05)


def test_qocs_follow_the_formulas_of_the_paper():
    patient = quiet()
    n, steps = 3, 75
    rng = np.random.default_rng(0)
    tremor = rng.uniform(0, 2, (n, steps))
    tremor[0] = 0.5
    half, none = np.full((n, steps), 0.5), np.zeros((n, steps))
    grasp, rating, share = measured_qocs(patient, np.zeros((n, 2)), np.ones((n, steps)), half, tremor, none).values()
    assert grasp == pytest.approx((patient.grasp_low + patient.grasp_high) / 2)
    for i in range(n):
        minutes = [tremor[i, :30], tremor[i, 30:60], tremor[i, 60:]]
        seconds = sum(2.0 * m.size for m in minutes if m.mean() >= 1)
        assert share[i] == pytest.approx(tremor_percent({"mild": seconds}, 2.0 * steps))
        Qoc(float(grasp[i]), int(rating[i]), float(share[i]))


@pytest.mark.parametrize(("form", "expected"), [("mean", 9.0 - 3 * 0.4), ("late", 9.0 - 3 * 0.75), ("peak_end", 9.0 - 3 * (1.0 + 0.5) / 2)])
def test_a_rating_goes_by_the_session_by_its_end_or_by_its_worst_and_last_minute(form, expected):
    patient = quiet(rating_form=RATINGS.index(form), rating_top=9.0, rating_scale=1.0, rating_noise=0.0, side=0.0)
    brady = np.repeat([[0.0, 0.0, 0.5, 1.0, 0.5]], 30, axis=1)
    found = measured_qocs(patient, np.zeros((1, 2)), np.ones((1, 150)), brady, np.zeros((1, 150)), np.zeros((1, 150)))
    assert found["rating"] == np.round(expected)


def test_an_artefact_raises_the_sensed_beta_and_no_symptom():
    patient = quiet(immediate=1.0, burden_share=0.5)
    leaking = patient._replace(leak=0.3)
    asked = np.repeat([[0.2, 1.0]], 30, axis=1)
    true, sensed = (simulate(p, 1.0, asked, days=new_days(1, 0, 1), key=1, steps=60) for p in (patient, leaking))
    np.testing.assert_allclose(sensed.beta, true.beta * (1 + 0.3 * asked))
    np.testing.assert_array_equal(sensed.brady, true.brady)


def test_every_trait_is_what_it_says():
    def drawn(trait, n=40):
        for seed in range(n):
            rng = np.random.default_rng([seed, 5])
            yield with_trait(draw_patient(0, rng), trait, rng)

    a = np.array([0.75, 1.0])
    low, full = np.transpose([dose(p.shape, a, np.full(2, p.half), p.steep) for p in drawn("saturating")])
    assert np.median(low / full) > 0.9  # three quarters of the amplitude do nearly all
    assert all(p.drift_sd > 0.4 * p.depth * 0.7 and p.immediate >= 0.8 for p in drawn("drifting"))
    assert all(dose(p.shape, np.array([p.half, 1.0]), np.full(2, p.half), 1.0).argmax() == 0 for p in drawn("overstimulated"))
    assert min(p.day_half for p in drawn("unsteady")) > max(p.day_half for p in drawn(None))
    assert not any(p.beta_answers for p in drawn("silent"))
    assert all(p.depth < 0.35 and p.grasp_high - p.grasp_low <= 0.6 for p in drawn("faint"))
    assert all(max(p.slow_up, p.slow_down) > 3 * min(p.slow_up, p.slow_down) for p in drawn("asymmetric"))
    assert all(p.leak > 0 and p.immediate == 0 for p in drawn("artefact"))
    with pytest.raises(ValueError, match="no trait 'lazy'"):
        with_trait(draw_patient(0, np.random.default_rng(0)), "lazy", np.random.default_rng(0))


def test_candidates_are_eight_to_twelve_and_several_are_near_cdbs():
    counts = set()
    for index in range(12):
        w = world("A", index)
        candidates = w.candidates()
        counts.add(len(candidates))
        assert {"constant low", "proportional slow", "near cDBS 1", "near cDBS 2"} <= set(candidates)
        near = w.truth(candidates["near cDBS 1"], 20)
        assert near.amplitude.value > 0.5
    assert counts <= set(range(8, 13))
    assert len(counts) > 1


def test_end_rewards_of_many_sessions_are_those_of_each():
    settings = MdpSettings(xi_beta=1.0, c2=3.0, c3=2.0, c4=5.0)
    grasp, rating, tremor = np.array([1.5, 2.5]), np.array([3.0, 9.0]), np.array([0.0, 62.5])
    each = [end_reward(settings, Qoc(float(g), int(r), float(t))) for g, r, t in zip(grasp, rating, tremor, strict=True)]
    np.testing.assert_allclose(end_rewards(settings, {"grasp_hz": grasp, "rating": rating, "tremor_percent": tremor}), each)


def test_a_relay_has_two_amplitudes_and_remembers_within_its_window():
    relay = RelayPolicy(1.0, 2.0, 0.3, 0.9, newest=1)
    rising, falling = [0.5, 0.5, 1.5], [2.5, 2.5, 1.5]
    np.testing.assert_array_equal(relay.act(np.array([rising, falling, [1.5] * 3, [0.5, 2.5, 0.9]])), [0.3, 0.9, 0.9, 0.3])


def test_parts_hold_the_same_mechanisms_and_a_third_of_them_no_estimator_contains():
    for part in ("A", "B", "C"):
        kinds = [kind for kind, _ in make_up(part)]
        traits = Counter(trait for _, trait in make_up(part))
        assert len(kinds) == WORLDS_PER_PART >= 60
        assert sum(kind != 0 for kind in kinds) >= WORLDS_PER_PART / 3
        assert set(kinds) == set(range(len(MECHANISMS)))
        assert traits.pop("silent") == 7
        assert traits.pop(None) == 11
        assert traits == dict.fromkeys(set(TRAITS) - {"silent"}, 6)
        assert Counter(make_up(part)) == Counter(make_up("A"))
    assert make_up("A") != make_up("B")


def test_a_world_depends_on_its_part_and_index_alone():
    first = world("A", 5)
    world.cache_clear()
    assert world("A", 5) == first
    assert world("A", 6).patient != first.patient
    with pytest.raises(ValueError, match="no world 60"):
        world("A", WORLDS_PER_PART)


@pytest.mark.parametrize("design", ["paper", "stratified", "ladder"])
def test_data_are_three_visits_of_logged_sessions(design):
    w = world("A", 2)
    buffer = w.data(design)
    assert [s.controller for s in buffer.sessions if s.visit == 2] == ["cdbs", "random", "random", "cdbs", "random", "random", "no_dbs"]
    assert {s.visit for s in buffer.sessions} == {1, 2, 3}
    random = [s for s in buffer.sessions if s.controller == "random"]
    assert all(s.amplitude.min() >= w.settings.bound for s in random)
    assert {s.random_bound for s in random} == {w.settings.bound}
    assert {s.uniform_bound for s in random} == ({w.settings.bound} if design == "paper" else {None})
    assert all(s.usable().all() and s.end_reward(w.settings) is not None for s in buffer.sessions)


def test_designs_share_days_and_minutes():
    plans = [visit_plan(world("A", 0).settings, design, 0, 3) for design in ("paper", "stratified")]
    assert [(r.visit, r.controller, r.hour, r.amplitudes.size) for r in plans[0]] == [
        (r.visit, r.controller, r.hour, r.amplitudes.size) for r in plans[1]
    ]


def test_the_truth_is_the_mean_of_logged_returns():
    w = world("A", 4)
    truth = w.truth(ConstantPolicy(0.7), 200)
    other = simulate(w.patient, w.settings.xi_beta, ConstantPolicy(0.7), days=new_days(w.key, 5000, 200), key=w.key, first=5000)
    rewards = np.where(other.beta < w.settings.xi_beta, 0.0, -1.0) - 0.3 * 0.7
    returns = rewards @ w.settings.gamma ** np.arange(300) + end_rewards(w.settings, other.qocs)
    error = np.hypot(truth.total.standard_error, returns.std(ddof=1) / np.sqrt(200))
    assert abs(truth.total.value - returns.mean()) < 4 * error
    assert truth.energy.value == pytest.approx(0.49)
    assert truth.total.value == pytest.approx(truth.step_return.value + truth.end_reward.value)


def test_days_move_what_a_policy_returns():
    """On the three days of the data the true return is not that of all days, by more than chance, somewhere."""
    gaps = []
    for i in range(6):
        w = world("A", i)
        new, there = w.truth(ConstantPolicy(0.6), 200), w.truth_on_data_days(ConstantPolicy(0.6), 200)
        gaps.append(abs(new.total.value - there.total.value) / np.hypot(new.total.standard_error, there.total.standard_error))
    assert max(gaps) > 3


def test_silent_beta_does_not_answer_while_symptoms_do():
    index = next(i for i, (_, trait) in enumerate(make_up("A")) if trait == "silent")
    w = world("A", index)
    full, off = (w.truth(ConstantPolicy(a), 200) for a in (1.0, 0.0))
    assert not w.patient.beta_answers
    assert abs(full.beta.value - off.beta.value) < 0.06 * full.beta.value
    assert off.qocs["grasp_hz"].value < full.qocs["grasp_hz"].value - 0.3


def test_a_responder_needs_both_the_margins_and_the_energy():
    w = world("A", 2)
    cdbs = w.truth(ConstantPolicy(1.0), 100)
    off = w.truth(ConstantPolicy(0.0), 100)
    assert not is_responder({"cDBS itself": cdbs}, cdbs)
    assert not is_responder({"off": off}, cdbs)
    saving = replace(cdbs, energy=Mean(0.8 * cdbs.energy.value, 0.0))
    assert is_responder({"saving": saving}, cdbs)
    at = {name: mean.value for name, mean in cdbs.qocs.items()}
    for worse in ({"grasp_hz": 0.89 * at["grasp_hz"]}, {"tremor_percent": at["tremor_percent"] + 11}, {"rating": at["rating"] - 1.1}):
        qocs = {**cdbs.qocs, **{name: Mean(value, 0.0) for name, value in worse.items()}}
        assert not is_responder({"worse": replace(saving, qocs=qocs)}, cdbs)


def test_visits_share_a_day_and_new_days_do_not():
    days = visit_days(9, np.array([1, 1, 2]), np.zeros(3))
    np.testing.assert_array_equal(days.effects[0], days.effects[1])
    assert not np.array_equal(days.effects[0], days.effects[2])
    assert len(np.unique(new_days(9, 0, 5).effects, axis=0)) == 5


def test_controllers_that_answer_wrongly_are_refused():
    patient, days = draw_patient(0, np.random.default_rng(0)), new_days(1, 0, 2)
    with pytest.raises(ValueError, match="need amplitudes of shape"):
        simulate(patient, 1.0, np.ones((1, 10)), days=days, key=1, steps=10)
    with pytest.raises(ValueError, match="outside"):
        simulate(patient, 1.0, np.full((2, 10), 1.2), days=days, key=1, steps=10)
    with pytest.raises(ValueError, match="longer than"):
        simulate(patient, 1.0, FOLLOWING, days=days, key=1, steps=10, window=31)
    with pytest.raises(ValueError, match="mechanisms"):
        draw_patient(99, np.random.default_rng(0))
