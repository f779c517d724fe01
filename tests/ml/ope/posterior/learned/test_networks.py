"""Learned differences: what guards them, and the constants that the project ships."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.ope.posterior.constants import FALLBACK
from ml.ope.posterior.estimator import Posterior, PosteriorConfig
from ml.ope.posterior.learned import networks
from ml.ope.posterior.learned.evidence import UNITS, reach_of
from ml.ope.posterior.learned.networks import FILE, differences_of, learned
from ml.ope.posterior.support import SessionSupport
from ml.policies.policy import ConstantPolicy
from tests.ml.ope.posterior.known_system import STEPS, KnownSystem

AMPLITUDES = (0.4, 0.55, 0.7, 0.85, 0.999, 1.0)


@pytest.fixture(scope="module")
def fitted(known_buffer):
    return Posterior(PosteriorConfig(draws=24)).fit(known_buffer)


def evidence_of(fitted, amplitudes):
    replays = fitted.replays([ConstantPolicy(a) for a in amplitudes], STEPS)
    leverage = np.array([SessionSupport(fitted.buffer).of(s).leverage for s in replays.summaries])
    return fitted.evidence(replays, leverage, STEPS), leverage


@pytest.fixture(scope="module")
def found(fitted):
    return evidence_of(fitted, AMPLITUDES)


def test_what_acts_like_cdbs_differs_by_nothing(found) -> None:
    differences = differences_of(*found, learned())
    assert differences.mean[-1].tolist() == [0.0] * 4
    assert differences.sd[-1].tolist() == [0.0] * 4
    assert np.abs(differences.mean[-2]).max() < 0.02
    assert differences.sd[-2, 0] < 0.2 * differences.sd[0, 0]


def test_known_differences_lie_in_their_intervals(fitted, found) -> None:
    """A system with an equation and a noise of its own, which no world that was learned from has."""
    system, rng, settings = KnownSystem(), np.random.default_rng(5), fitted.buffer.settings
    discount = settings.gamma ** np.arange(STEPS)

    def true(a: float) -> float:
        runs = [system.session(i, 1, "other", np.full(STEPS, a), rng) for i in range(60)]
        return float(np.mean([(s.rewards(settings) * discount).sum() for s in runs])) / reach_of(fitted.buffer, STEPS)

    truth = np.array([true(a) for a in AMPLITUDES])
    differences = differences_of(*found, learned())
    assert np.all(np.abs(differences.mean[:4, 0] - (truth - truth[-1])[:4]) < 1.645 * differences.sd[:4, 0])
    assert differences.mean[0, 0] < -0.25


def test_a_record_unlike_all_others_is_left_to_the_structures(found) -> None:
    evidence, leverage = found
    strange = replace(evidence, parts={name: 1e6 * np.ones_like(v) for name, v in evidence.parts.items()})
    differences = differences_of(strange, leverage, learned())
    assert differences.trust.max() < 0.2
    assert np.abs(differences.mean - evidence.expected)[:, 0].max() < 0.2 * np.abs(learned().networks.scale[0]) * 10
    error = np.sqrt(FALLBACK["steps"].variance(leverage[:1]) + evidence.spread[:1, 0] ** 2)
    assert differences.sd[0, 0] > 0.8 * error


def test_a_quantity_that_nobody_measured_stays_with_the_structures(found) -> None:
    evidence, leverage = found
    bare = replace(evidence, known=np.array([True, False, False, False]))
    differences = differences_of(bare, leverage, learned())
    np.testing.assert_allclose(differences.mean[:, 1:], evidence.expected[:, 1:])


def test_evidence_on_a_policy_does_not_depend_on_the_others(fitted, found) -> None:
    alone, _ = evidence_of(fitted, (0.55, 1.0))
    for name, values in alone.parts.items():
        np.testing.assert_allclose(values, found[0].parts[name][[1, -1]], rtol=1e-9, atol=1e-12, err_msg=name)


def test_the_constants_are_small_and_of_the_version_of_the_code(monkeypatch) -> None:
    assert FILE.stat().st_size < 1e6
    constants = learned()
    assert np.linalg.eigvalsh(constants.together).min() > 0
    assert np.abs(constants.level_against).max() < 1
    assert constants.wider.shape == constants.level_own.shape == (len(UNITS),)
    monkeypatch.setattr(networks, "VERSION", 0)
    with pytest.raises(ValueError, match="posterior_constants"):
        learned.__wrapped__()
