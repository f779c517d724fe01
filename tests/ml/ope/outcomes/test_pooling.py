"""Dose shapes pooled over participants, against closed forms, sums over all assignments, and simulated participants."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.special import logsumexp

from ml.ope.outcomes.minutes import DOSE, SHAPES, by_minute
from ml.ope.outcomes.model import fit_end_model
from ml.ope.outcomes.pooling import CONCENTRATION, FEWEST, gain, pool, prove, shape_prior
from tests.ml.ope.outcomes.test_model import SETTINGS, at, buffer_of

K = len(SHAPES)
CERTAIN = 60.0
"""Log evidence by which a shape is as good as known."""


def certain(shapes):
    return CERTAIN * np.eye(K)[np.asarray(shapes)]


def exact_prior(log_evidence):
    """Compute E[p | data] by the sum over every assignment of shapes: Dirichlet-multinomial times evidences."""
    n, k = log_evidence.shape
    logs, means = [], []
    for shapes in product(range(k), repeat=n):
        counts = np.zeros(k)
        weight = 0.0
        for i, s in enumerate(shapes):
            weight += np.log((CONCENTRATION + counts[s]) / (k * CONCENTRATION + i)) + log_evidence[i, s]
            counts[s] += 1
        logs.append(weight)
        means.append((CONCENTRATION + counts) / (k * CONCENTRATION + n))
    return np.exp(np.array(logs) - logsumexp(logs)) @ np.array(means)


def participant(rng, shape, sessions=48, noise=0.03):
    """Simulate sessions whose grasp answers to the dose along one of `SHAPES`, by an amount of the participant's own."""
    doses = rng.uniform(0.05, 1.0, sessions)
    answer = by_minute(np.ones((sessions, 60)), doses[:, None] * np.ones(60), SETTINGS).means[:, DOSE + shape]
    grasps = rng.uniform(1.0, 2.0) + rng.uniform(0.8, 1.4) * answer + noise * rng.standard_normal(sessions)
    return buffer_of(doses, grasps, np.arange(sessions) // 12)


def evidence_of(buffer):
    return fit_end_model(buffer).shape_evidence["grasp"]


def test_without_others_and_where_their_data_tell_no_shape_the_prior_is_flat():
    np.testing.assert_allclose(np.exp(shape_prior(np.zeros((0, K)))), 1 / K)
    np.testing.assert_allclose(np.exp(shape_prior(np.zeros((7, K)))), 1 / K)


def test_known_shapes_are_counted_and_the_flat_prior_counts_for_one_of_each():
    found = np.exp(shape_prior(certain([2, 2, 2, 5])))
    expected = (np.bincount([2, 2, 2, 5], minlength=K) + CONCENTRATION) / (4 + K * CONCENTRATION)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_the_prior_is_near_the_sum_over_all_assignments():
    rng = np.random.default_rng(0)
    for spread in (0.3, 1.0, 3.0):
        for n in (1, 2, 4):
            evidence = spread * rng.standard_normal((n, 4))
            found, exact = np.exp(shape_prior(evidence)), exact_prior(evidence)
            assert found.sum() == pytest.approx(1.0)
            np.testing.assert_allclose(found, exact, atol=1e-9 if n == 1 else 0.02)


def test_a_constant_in_the_evidence_of_a_participant_changes_nothing():
    evidence = np.random.default_rng(1).standard_normal((5, K))
    moved = evidence + np.array([[-900.0], [0.0], [3.0], [70.0], [1e4]])
    np.testing.assert_allclose(shape_prior(moved), shape_prior(evidence), atol=1e-8)
    np.testing.assert_allclose(prove(moved).gains, prove(evidence).gains, atol=1e-8)


@pytest.mark.parametrize("n", [4, 5, 12])
def test_one_shape_for_all_gains_what_the_closed_form_says(n):
    # the others' n - 1 count besides one of each shape: (c + n - 1) / (K c + n - 1) instead of 1 / K
    expected = np.log(K * (CONCENTRATION + n - 1) / (K * CONCENTRATION + n - 1))
    found = prove(certain([3] * n))
    np.testing.assert_allclose(found.gains, expected, rtol=1e-9)
    assert found.holds


def test_a_shape_of_its_own_for_everybody_loses_what_the_closed_form_says():
    found = prove(certain(range(6)))
    np.testing.assert_allclose(found.gains, np.log(K * CONCENTRATION / (K * CONCENTRATION + 5)), rtol=1e-9)
    assert not found.holds


def test_fewer_than_four_are_never_pooled_and_neither_is_a_gain_within_its_error():
    assert FEWEST == 4
    assert not prove(certain([3] * 3)).holds
    mixed = prove(certain([3, 3, 0, 8, 7]))
    assert -mixed.standard_error < mixed.mean < mixed.standard_error
    assert not mixed.holds
    assert (prove(certain([3])).standard_error, prove(np.zeros((0, K))).mean) == (None, None)


def test_what_a_prior_is_worth_is_the_ratio_of_two_sums():
    evidence, prior = np.log(np.array([0.2, 0.6, 0.2])), np.log(np.array([0.1, 0.8, 0.1]))
    assert gain(evidence, prior) == pytest.approx(np.log((0.02 + 0.48 + 0.02) / (1 / 3)))


def test_only_outcomes_whose_proof_holds_have_a_prior_and_an_outcome_may_be_absent():
    alike, apart = certain([4] * 5), certain([0, 2, 4, 6, 8])
    others = [{"grasp": list(a), "rating": list(b)} for a, b in zip(alike, apart, strict=True)]
    del others[0]["rating"]
    own = {"grasp": certain([4])[0], "rating": certain([4])[0]}
    found = pool(own, others)
    assert list(found.priors) == ["grasp"]
    np.testing.assert_allclose(found.priors["grasp"], shape_prior(alike))  # the participant itself is no part of its prior
    np.testing.assert_allclose(found.proofs["grasp"].gains, prove(certain([4] * 6)).gains)  # but of the proof
    assert {o: p.participants for o, p in found.proofs.items()} == {"grasp": 6, "rating": 5}
    assert pool({}, others).proofs == {}
    with pytest.raises(ValueError, match="dose shapes of the grasp"):
        pool(own, [{"grasp": [0.0, 1.0]}])
    with pytest.raises(ValueError, match="not finite"):
        pool({"grasp": [np.nan] * K}, [])


def test_a_participant_unlike_the_others_counts_in_the_proof():
    # two of one shape and one of another: a third one alike makes the proof hold, one who is unlike all does not
    others = [{"grasp": row} for row in certain([3, 3, 0])]
    assert pool({"grasp": certain([3])[0]}, others).proofs["grasp"].holds
    assert not pool({"grasp": certain([8])[0]}, others).proofs["grasp"].holds


def test_participants_of_one_shape_gain_about_what_the_closed_form_says_and_unrelated_ones_nothing():
    rng = np.random.default_rng(2)
    steep = SHAPES.index((0.5, 4))
    alike = prove(np.array([evidence_of(participant(rng, steep)) for _ in range(6)]))
    assert alike.mean == pytest.approx(np.log(K * (CONCENTRATION + 5) / (K * CONCENTRATION + 5)), abs=0.1)
    assert alike.holds
    unrelated = prove(np.array([evidence_of(participant(rng, k)) for k in rng.permutation(K)[:6]]))
    assert unrelated.mean < 0
    assert not unrelated.holds


def test_a_participant_whose_own_data_tell_the_shape_keeps_it_against_all_others():
    rng = np.random.default_rng(3)
    own, others = SHAPES.index((0.3, 4)), SHAPES.index((0.9, 4))
    buffer, prior = participant(rng, own), shape_prior(certain([others] * 20))
    pooled = fit_end_model(buffer, shape_priors={"grasp": prior})
    assert max(zip(pooled.regressions["grasp"].weights, pooled.regressions["grasp"].members, strict=True))[1].shape == own


def test_a_prior_moves_the_weights_of_shapes_alone_and_the_flat_one_nothing():
    rng = np.random.default_rng(4)
    buffer = participant(rng, SHAPES.index((0.7, 4)), sessions=10, noise=0.3)
    alone = fit_end_model(buffer, draws=20)
    flat = fit_end_model(buffer, draws=20, shape_priors={"grasp": np.full(K, -np.log(K))})
    shaped = fit_end_model(buffer, draws=20, shape_priors={"grasp": shape_prior(certain([SHAPES.index((0.7, 4))] * 8))})
    minutes = at(0.2, 0.4, 0.6, 0.8, 1.0)
    np.testing.assert_allclose(flat.predict(minutes), alone.predict(minutes), rtol=1e-9)
    np.testing.assert_array_equal(shaped.regressions["grasp"].shape_evidence, alone.regressions["grasp"].shape_evidence)
    fixed = {(m.shape, m.day_variance): m.fixed for m in alone.regressions["grasp"].members}
    for member in shaped.regressions["grasp"].members:
        if (member.shape, member.day_variance) in fixed:
            np.testing.assert_array_equal(member.fixed, fixed[member.shape, member.day_variance])
    share = {name: sum(w for w, m in zip(x.regressions["grasp"].weights, x.regressions["grasp"].members, strict=True)
             if m.shape == SHAPES.index((0.7, 4))) for name, x in (("alone", alone), ("shaped", shaped))}  # fmt: skip
    assert share["shaped"] > 2 * share["alone"]
