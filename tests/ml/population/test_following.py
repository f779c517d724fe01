"""The second population: bouts of need, changes between visits, symptoms that do not answer, and what following beta is truly worth."""

from __future__ import annotations

import importlib
from collections import Counter

import numpy as np
import pytest

from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.population.virtual import (
    MECHANISMS,
    WORLDS_PER_PART,
    Days,
    InversePolicy,
    RelayPolicy,
    closed_loops,
    draw_patient,
    new_days,
    simulate,
    world,
    worth_of_following,
)
from ml.population.virtual.following import deal, with_change, with_worth, without_answer
from ml.population.virtual.patient import MILD
from ml.population.virtual.world import visit_plan

FIELDS = ("lead", "beta", "brady", "tremor", "overload")


def patient_with(worth, seed=0, kind=0):
    rng = np.random.default_rng([seed, 77])
    return with_worth(draw_patient(kind, rng), worth, rng)


@pytest.mark.parametrize("worth", ["pays", "none", "hurts"])
@pytest.mark.parametrize("kind", range(len(MECHANISMS)))
def test_the_kernel_has_bouts_as_the_equations_do(kind, worth):
    patient, days = patient_with(worth, 1, kind)._replace(answers=0.7), new_days(3, 0, 4)
    follow = ProportionalPolicy(0.6, 1.8, 0.2, 3)
    fast, read = (simulate(patient, 1.2, follow, days=days, key=3, steps=90, readable=r) for r in (False, True))
    for field in FIELDS:
        np.testing.assert_allclose(getattr(fast, field), getattr(read, field), rtol=1e-9, atol=1e-9, err_msg=field)
    for name, values in fast.qocs.items():
        np.testing.assert_allclose(values, read.qocs[name], rtol=1e-9, atol=1e-9, err_msg=name)


def test_bouts_have_their_duty_and_length_and_move_beta_by_what_they_say():
    quiet = dict.fromkeys(
        ("noise", "drift_sd", "act_beta", "act_half", "day_level", "day_gain", "session_level", "med_beta", "ring_gain"), 0.0
    )
    patient = patient_with("pays")._replace(**quiet, bout_in=0.02, bout_out=0.05, bout_beta=0.5, bout_half=0.0, log_scale=1, unit=1.0)
    x = np.log(simulate(patient, 1.0, ConstantPolicy(1.0), days=new_days(9, 0, 400), key=9, steps=300).beta)
    high = x > (x.max() + x.min()) / 2
    assert np.ptp(x) == pytest.approx(0.5)
    assert high.mean() == pytest.approx(0.02 / 0.07, abs=0.02)
    assert high[:, 0].mean() == pytest.approx(0.02 / 0.07, abs=0.07)  # stationary from the beginning
    ends = (high[:, :-1] & ~high[:, 1:]).sum() / high[:, :-1].sum()
    assert ends == pytest.approx(0.05, abs=0.004)


def test_beta_rises_with_need_where_following_pays_and_falls_where_it_hurts():
    assert patient_with("pays").bout_beta > 0 > patient_with("hurts").bout_beta
    none = patient_with("none")
    assert none.bout_in == none.act_half == none.act_need == none.act_tolerance == 0


def test_a_change_moves_the_response_from_its_visit_on():
    patient = draw_patient(0, np.random.default_rng(2))
    changed = with_change(patient, np.random.default_rng(2))
    effects = new_days(1, 0, 1).effects
    before, after = (Days(effects, np.zeros(1), np.full(1, c)) for c in (0.0, 1.0))

    def beta(p, days):
        return simulate(p, 1.0, ConstantPolicy(0.6), days=days, key=1, steps=60).beta

    np.testing.assert_array_equal(beta(changed, before), beta(patient, before))
    assert np.all(beta(changed, after) > beta(patient, after))
    assert changed.change_visit in (2, 3)
    w = next(w for w in (world("A", i, 2) for i in range(WORLDS_PER_PART)) if w.patient.change_visit == 3)
    rows = visit_plan(w.settings, "paper", 0, 3)
    assert list(w.data_days(rows, 0).change) == [float(row.visit >= 3) for row in rows]


def test_symptoms_that_do_not_answer_are_the_same_at_any_dose():
    patient = without_answer(patient_with("pays"))
    low, full = (simulate(patient, 1.0, ConstantPolicy(a), days=new_days(2, 0, 50), key=2, steps=60) for a in (0.3, 1.0))
    np.testing.assert_array_equal(low.brady, full.brady)
    np.testing.assert_array_equal(low.qocs["rating"], full.qocs["rating"])
    np.testing.assert_array_equal(low.qocs["tremor_percent"], full.qocs["tremor_percent"])


def test_outcomes_follow_from_minutes():
    run = simulate(patient_with("pays", 3), 1.0, ConstantPolicy(0.5), days=new_days(2, 0, 20), key=2, steps=75)
    minutes = run.by_minute("tremor")
    assert minutes.shape == (20, 3)
    np.testing.assert_allclose(minutes[:, 2], run.tremor[:, 60:].mean(1))
    np.testing.assert_allclose(run.qocs["tremor_percent"], 100 * ((minutes >= MILD) @ np.array([30, 30, 15])) / 75)


def test_an_inverse_controller_gives_least_where_the_other_gives_most():
    proportional = ProportionalPolicy(1.0, 2.0, 0.4)
    states = np.array([[0.5], [1.5], [3.0]])
    np.testing.assert_allclose(InversePolicy(proportional).act(states), [1.0, 0.7, 0.4])


def test_worth_compares_with_the_best_constant_of_no_more_energy():
    # constants return 10 - 10 (a - 0.5)^2; two loops spend 0.64 and return 9.5 and 10.5: the best constant that spends less is 0.5
    values = {"worse": (9.5, 0.64), "better": (10.5, 0.64)}

    class Named:
        def __init__(self, name):
            self.name = name

    def ask(policy):
        return values[policy.name] if isinstance(policy, Named) else (10 - 10 * (policy.amplitude - 0.5) ** 2, policy.amplitude**2)

    found = worth_of_following(ask, {n: Named(n) for n in values})
    assert (found.loop, found.closed) == ("better", 10.5)
    assert found.constant == pytest.approx(10.0)
    assert found.range == pytest.approx(10.5 - 7.5)
    assert found.pays
    values["better"] = (9.9, 0.09)  # at the energy of 0.3 the constant returns 9.6
    assert worth_of_following(ask, {n: Named(n) for n in values}).constant == pytest.approx(9.6)


def test_worths_changes_and_unanswered_symptoms_are_dealt_out():
    dealt = deal(41, 60)
    assert Counter(d.worth for d in dealt) == {"pays": 39, "hurts": 9, "none": 12}
    assert sum(d.changes for d in dealt) == sum(not d.answers for d in dealt) == 6
    assert deal(41, 60) == dealt != deal(53, 60)


def test_the_first_population_keeps_its_worlds_and_the_second_has_its_own():
    first, second = world("A", 7), world("A", 7, 2)
    assert first.worth is None
    assert first.patient.bout_in == 0
    assert second.key != first.key
    assert second.name.endswith(second.worth)
    kinds = Counter(type(p) for p in second.candidates().values())
    assert kinds[ConstantPolicy] == 3
    assert kinds[RelayPolicy] == kinds[ProportionalPolicy] == 2
    assert kinds[InversePolicy] == 1


@pytest.mark.slow
def test_following_beta_truly_pays_in_about_half_of_many_worlds_and_hurts_in_some(monkeypatch):
    module = importlib.import_module("ml.population.virtual.world")
    shares = []
    for seed in (1009, 1013):
        monkeypatch.setitem(module.FOLLOWING_PARTS, "A", seed)
        world.cache_clear()
        for index in range(0, WORLDS_PER_PART, 3):
            w = world("A", index, 2)

            def ask(policy, w=w):
                truth = w.truth(policy, 40)
                return truth.total.value, truth.energy.value

            loops = closed_loops(w.settings.xi_beta, w.spread, w.settings.window)
            found = worth_of_following(ask, loops, np.arange(0.3, 1.001, 0.1))
            shares.append((found.pays, found.closed - found.constant <= -0.05 * found.range))
    world.cache_clear()
    pays, hurts = np.mean(shares, axis=0)
    assert 0.35 <= pays <= 0.65  # two standard errors of 40 worlds around a half
    assert hurts >= 0.1
