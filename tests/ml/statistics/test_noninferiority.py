"""Non-inferiority, then energy: the rules one by one, and the error at the margin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t, ttest_1samp

from ml.statistics.noninferiority import (
    FailureRule,
    Inconclusive,
    Inferior,
    NonInferiorAndSaving,
    Outcome,
    assess,
    counted_energy,
)
from ml.statistics.within_visits.contrasts import Measurements, Reason, visit_contrasts

EACH = 3


def design(visits):
    return np.repeat(np.arange(visits), 2 * EACH), np.tile([False, True], visits * EACH)


def study(visits=6, loss=0.0, seed=0, noise=0.05, saved=0.4, stopped=()):
    rng = np.random.default_rng(seed)
    visit, arms = design(visits)
    flags = np.isin(np.arange(visit.size), stopped)
    grasp = 2.3 + rng.normal(0, 0.2, visits)[visit] - loss * arms + rng.normal(0, noise, visit.size)
    rating = np.clip(np.round(8 + rng.normal(0, 0.7, visit.size)), 1, 10)
    tremor = np.clip(10 + rng.normal(0, 3, visit.size), 0, 100)
    energy = Measurements.of(np.where(arms, 1 - saved, 1.0) + rng.normal(0, 0.03, visit.size), visit, arms)
    outcomes = [
        Outcome("grasp", Measurements.of(grasp, visit, arms), flags, 0.3, True, failure=float(grasp.min()), worst_possible=0.0),
        Outcome("rating", Measurements.of(rating, visit, arms, resolution=1), flags, 1.5, True, failure=1.0, worst_possible=1.0),
        Outcome("tremor", Measurements.of(tremor, visit, arms), flags, 10.0, False, failure=100.0, worst_possible=100.0),
    ]
    return outcomes, energy, flags


def test_nothing_lost_and_energy_saved_is_the_verdict_with_its_per_cent():
    found = assess(*study())
    assert isinstance(found.verdict, NonInferiorAndSaving)
    assert found.verdict.low < 40 < found.verdict.high
    assert found.p_non_inferior == max(r.p_non_inferior for r in found.outcomes) < 0.05
    assert [v for _, v in found.sensitivity] == [found.verdict] * 3


def test_each_p_value_is_the_one_sided_t_test_of_the_visits_against_the_margin():
    outcomes, energy, flags = study(loss=0.1)
    grasp = assess(outcomes, energy, flags).outcomes[0]
    contrasts = visit_contrasts(outcomes[0].data).contrast
    assert grasp.p_non_inferior == pytest.approx(ttest_1samp(contrasts, -0.3, alternative="greater").pvalue)
    assert grasp.p_inferior == pytest.approx(ttest_1samp(contrasts, -0.3, alternative="less").pvalue)


def test_where_less_is_better_more_is_a_loss():
    outcomes, energy, flags = study()
    worse = replace(outcomes[2], data=replace(outcomes[2].data, value=outcomes[2].data.value + 30 * outcomes[2].data.tested))
    assert assess([worse], energy, flags).verdict == Inferior(("tremor",))
    better = replace(outcomes[2], data=replace(outcomes[2].data, value=outcomes[2].data.value - 5 * outcomes[2].data.tested))
    assert isinstance(assess([better], energy, flags).verdict, NonInferiorAndSaving)


def test_one_outcome_beyond_its_margin_is_inferior_whatever_is_saved():
    assert assess(*study(loss=0.8)).verdict == Inferior(("grasp",))


def test_one_outcome_not_shown_leaves_all_open_and_names_the_visits_it_takes():
    found = assess(*study(loss=0.12, noise=0.25, visits=4, seed=2)).verdict
    assert isinstance(found, Inconclusive)
    assert "grasp" in found.open
    assert found.more_visits is None or found.more_visits >= 1
    easy = assess(*study(visits=2, seed=3)).verdict
    assert isinstance(easy, Inconclusive)
    assert easy.more_visits is not None
    assert 1 <= easy.fewest_visits <= easy.more_visits  # sessions can replace some visits, never all


def test_energy_is_tested_only_behind_the_gate_and_is_open_where_nothing_is_saved():
    outcomes, energy, flags = study(saved=0.0)
    found = assess(outcomes, energy, flags)
    assert isinstance(found.verdict, Inconclusive)
    assert found.verdict.open == ("energy",)
    closed = assess(*study(loss=0.3, seed=1))
    assert closed.saving.p_value < 0.05
    assert not isinstance(closed.verdict, NonInferiorAndSaving)


@pytest.mark.parametrize("visits", [1, 2])
def test_fewer_than_three_visits_with_both_arms_conclude_nothing(visits):
    for loss in (0.0, 5.0):
        found = assess(*study(visits=visits, noise=1e-6, loss=loss)).verdict
        assert isinstance(found, Inconclusive)
        assert found.untested == tuple((name, Reason.TOO_FEW_VISITS) for name in ("grasp", "rating", "tremor"))
        assert found.more_visits is None or found.more_visits + visits >= 3


def test_a_session_stopped_for_the_patients_sake_is_a_failure_even_where_its_values_are_missing():
    outcomes, energy, flags = study(stopped=(1, 9))
    missing = np.where(flags, np.nan, outcomes[1].data.value)
    rating = replace(outcomes[1], data=replace(outcomes[1].data, value=missing))
    assert rating.counted(FailureRule.WORST_CASE).value[[1, 9]].tolist() == [1.0, 1.0]
    assert np.isnan(rating.counted(FailureRule.AS_MEASURED).value[1])
    found = assess([outcomes[0], rating, outcomes[2]], energy, flags)
    assert not isinstance(found.verdict, NonInferiorAndSaving)
    assert [r.failures for r in found.outcomes] == [2, 2, 2]
    assert [r.missing for r in found.outcomes] == [0, 0, 0]
    assert isinstance(dict(found.sensitivity)[FailureRule.AS_MEASURED], NonInferiorAndSaving)


def test_a_failure_of_unknown_value_is_missing():
    outcomes, energy, flags = study(stopped=(1,))
    unknown = replace(outcomes[0], failure=None)
    assert np.isnan(unknown.counted(FailureRule.WORST_CASE).value[1])
    assert [r.missing for r in assess([unknown, *outcomes[1:]], energy, flags).outcomes] == [1, 0, 0]


def test_the_end_of_the_scale_is_what_a_failure_counts_as_in_one_of_the_sensitivity_analyses():
    outcomes, energy, flags = study(stopped=(0, 1))
    worst = [o.counted(FailureRule.END_OF_SCALE).value for o in outcomes]
    assert [v[1] for v in worst] == [0.0, 1.0, -100.0]
    assert worst[0][0] == outcomes[0].data.value[0]  # of cDBS: as measured
    mild = [replace(o, failure=float(o.data.value[2])) for o in outcomes]
    found = assess(mild, energy, flags)
    assert isinstance(found.verdict, NonInferiorAndSaving)
    assert not isinstance(dict(found.sensitivity)[FailureRule.END_OF_SCALE], NonInferiorAndSaving)


def test_a_stopped_cdbs_session_helps_the_controller_only_where_both_arms_count():
    outcomes, _, _ = study(stopped=(0,))
    assert outcomes[1].counted(FailureRule.WORST_CASE).value[0] == outcomes[1].data.value[0]
    assert outcomes[1].counted(FailureRule.BOTH_ARMS).value[0] == 1.0


def test_a_stopped_session_saves_no_energy():
    visit, arms = np.array([1, 1, 1, 2, 2]), np.array([False, True, True, False, True])
    energy = Measurements.of([1.0, 0.2, 0.5, 0.9, np.nan], visit, arms)
    stopped = np.array([False, True, False, False, True])
    assert counted_energy(energy, stopped, FailureRule.WORST_CASE).value.tolist() == [1.0, 1.0, 0.5, 0.9, 0.9]
    assert counted_energy(energy, stopped, FailureRule.AS_MEASURED) is energy


def test_the_rating_may_be_judged_by_the_win_probability():
    outcomes, energy, flags = study(visits=8)
    rating = replace(outcomes[1], scale="win_probability", margin=0.3)
    found = assess([rating], energy, flags)
    assert found.outcomes[0].average.null == 0.5
    assert isinstance(found.verdict, NonInferiorAndSaving)
    assert assess([replace(rating, margin=0.01)], energy, flags).verdict.open == ("rating",)


def ratings(one, two, visits=6, margin=1.0, scale="ordinal"):
    """Build equal ratings of either arm at every visit, but for one session of cDBS that differs from visit to visit."""
    value = np.concatenate([np.r_[one, two, 7 + v % 2] for v in range(visits)])
    arms = np.tile(np.r_[np.ones(len(one)), np.zeros(len(two) + 1)] == 1, visits)
    visit = np.repeat(np.arange(visits), len(one) + len(two) + 1)
    data = Measurements.of(value, visit, arms, resolution=1)
    return Outcome("rating", data, np.zeros(visit.size, dtype=bool), margin, True, scale, 1.0)


def shares(outcome):
    return visit_contrasts(outcome.counted(FailureRule.WORST_CASE), "ordinal").contrast


def test_an_ordinal_rating_is_judged_by_the_pairs_that_it_wins_once_the_margin_is_added():
    even = ratings([7, 6], [7])  # of the pairs with 7 and 7: 8 wins both, 7 ties both; with 8: 8 ties, 7 loses
    assert shares(even)[:2].tolist() == [0.75, pytest.approx((1 + 0.5 + 0.5 + 0) / 4)]
    # half a point is half way between none and one
    wins = [shares(ratings([7, 6], [7], margin=m))[0] for m in (1e-9, 0.5, 1.0)]
    assert wins[1] == pytest.approx((wins[0] + wins[2]) / 2)
    assert wins[2] == 0.75
    assert wins[0] == pytest.approx(0.25)
    # that steps are equal is not assumed: a single very low rating costs no more than its pairs
    deep, shallow = (shares(ratings([7, low], [7])) for low in (1, 5))
    assert deep == pytest.approx(shallow)
    energy = Measurements.of(np.where(even.data.tested, 0.6, 1.0), even.data.visit, even.data.tested, resolution=0.05)
    found = assess([ratings([8, 7], [7])], energy, even.stopped)
    assert (found.outcomes[0].loss, found.outcomes[0].average.null) == (0.5, 0.5)
    assert found.outcomes[0].average.high <= 1
    assert isinstance(found.verdict, NonInferiorAndSaving)
    assert assess([ratings([3, 4], [7])], energy, even.stopped).verdict == Inferior(("rating",))


def test_a_failure_gains_nothing_from_the_margin_of_an_ordinal_rating():
    plain = ratings([7, 7], [1])
    failed = replace(plain, stopped=plain.data.tested & (np.arange(plain.data.value.size) % 4 == 0))
    counted = failed.counted(FailureRule.WORST_CASE)
    assert counted.value[failed.stopped].tolist() == [1.0] * 6
    assert counted.value[plain.data.tested & ~failed.stopped].tolist() == [8.0] * 6
    assert failed.counted(FailureRule.AS_MEASURED).value[failed.stopped].tolist() == [8.0] * 6
    with pytest.raises(ValueError, match="compared in steps"):
        replace(plain, data=replace(plain.data, resolution=0.0))


def test_at_the_margin_of_an_ordinal_rating_it_errs_no_more_than_its_level():
    rng, wrong, number = np.random.default_rng(11), 0, 600
    visit, arms = design(6)
    flags, energy = np.zeros(visit.size, dtype=bool), Measurements.of(np.where(arms, 0.6, 1.0), visit, arms, resolution=0.05)
    for _ in range(number):  # the controller loses exactly one point, on days that differ
        value = np.round(7 + rng.normal(0, 0.7, 6)[visit] + rng.normal(0, 0.7, visit.size)) - arms
        outcome = Outcome("rating", Measurements.of(value, visit, arms, resolution=1), flags, 1.0, True, "ordinal", 1.0)
        wrong += isinstance(assess([outcome], energy, flags, plan=False).verdict, NonInferiorAndSaving)
    assert wrong / number <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / number)


def test_at_the_margin_it_errs_no_more_than_its_level_even_where_effects_differ_between_visits():
    wrong, number = 0, 400
    rng = np.random.default_rng(5)
    visit, arms = design(4)
    energy = Measurements.of(np.where(arms, 0.6, 1.0) + 0.01 * rng.standard_normal(visit.size), visit, arms)
    flags = np.zeros(visit.size, dtype=bool)
    for _ in range(number):
        grasp = rng.standard_normal(4)[visit] - (0.3 + 0.2 * rng.standard_normal(4)[visit]) * arms + 0.1 * rng.standard_normal(visit.size)
        result = assess([Outcome("grasp", Measurements.of(grasp, visit, arms), flags, 0.3, True)], energy, flags, plan=False)
        wrong += isinstance(result.verdict, NonInferiorAndSaving)
    assert wrong / number <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / number)


@pytest.mark.parametrize("value", [np.nan, 1.0])
def test_no_values_or_all_the_same_are_a_typed_answer(value):
    visit, arms = design(4)
    flags = np.zeros(visit.size, dtype=bool)
    data = Measurements.of(np.full(visit.size, value), visit, arms)
    found = assess([Outcome("grasp", data, flags, 0.3, True)], data, flags)
    assert isinstance(found.verdict, Inconclusive)
    why = Reason.ALL_EQUAL if value == 1.0 else Reason.NO_SESSION
    assert found.verdict.untested == (("grasp", why),)
    assert found.verdict.unplanned == (("grasp", why), ("energy", why))
    assert found.p_non_inferior is None


def test_margins_that_mean_nothing_are_refused_in_words():
    outcomes, energy, flags = study()
    with pytest.raises(ValueError, match="margin of grasp must be above 0"):
        replace(outcomes[0], margin=0.0)
    with pytest.raises(ValueError, match=r"below 0\.5"):
        replace(outcomes[1], scale="win_probability", margin=0.6)
    with pytest.raises(ValueError, match="at least one outcome"):
        assess([], energy, flags)
    with pytest.raises(ValueError, match="between 0 and 0"):
        assess(outcomes, energy, flags, alpha=0.5)


def test_a_failure_is_not_explained_away_as_a_drift():
    # the stopped sessions are last in their visits, where a drift fitted through them would take them out of the contrast
    visit, place = np.repeat(np.arange(5), 7), np.tile(np.arange(7.0), 5)
    arms = np.tile([False, True, False, True, False, True, True], 5)
    stopped = (place == 6) & (visit < 4)
    rng = np.random.default_rng(3)
    values = 7 + rng.normal(0, 0.3, visit.size)
    rating = Measurements.of(values, visit, arms, order=place, resolution=1)
    energy = Measurements.of(np.where(arms, 0.5, 1.0) + rng.normal(0, 0.01, visit.size), visit, arms, order=place)
    found = assess([Outcome("rating", rating, stopped, 1.0, True, failure=1.0)], energy, stopped)
    assert isinstance(found.verdict, Inconclusive)
    assert found.outcomes[0].average.estimate == pytest.approx(-1.2, abs=0.3)  # four of five visits lose 6 points in one of four sessions
    as_measured = dict(found.sensitivity)[FailureRule.AS_MEASURED]
    assert isinstance(as_measured, NonInferiorAndSaving)
    assert as_measured.high <= 100


def test_three_outcomes_that_are_each_probably_worse_are_inferior_by_hommel():
    # each outcome's one-sided p of a loss beyond its margin is between .0167 and .05: Holm's first step rejects none, Simes' test all
    visits, flags = np.repeat(np.arange(6), 2), np.zeros(12, dtype=bool)
    arms, pattern = np.tile([False, True], 6), np.array([-1.0, 0.0, 1.0, -1.0, 0.0, 1.0])
    p_wanted = (0.03, 0.032, 0.035)
    outcomes = []
    for k, p in enumerate(p_wanted):
        spread = pattern.std(ddof=1) / np.sqrt(6)
        contrast = pattern - 1.0 + spread * t.ppf(p, 5)  # mean below the margin of 1 by that many standard errors
        value = np.where(arms, 5.0 + contrast[visits], 5.0)
        outcomes.append(Outcome(f"outcome {k}", Measurements.of(value, visits, arms), flags, 1.0, True))
    found = assess(outcomes, Measurements.of(np.where(arms, 0.6, 1.0), visits, arms), flags)
    assert [r.p_inferior for r in found.outcomes] == pytest.approx(p_wanted)
    assert found.verdict == Inferior(("outcome 0", "outcome 1", "outcome 2"))
