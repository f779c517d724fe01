"""The impulse-response model against closed forms, readable twins and sessions whose response is known."""

from __future__ import annotations

import numpy as np
import pytest

from ml.mdp import MdpSettings
from ml.ope.impulse.dynamics import (
    ALPHAS,
    EDGES,
    MEMORY,
    SHAPES,
    STRETCHES,
    LaggedMeans,
    ResponseTable,
    dose,
    fit_impulse,
    lagged_means,
    prior_root,
)
from ml.ope.impulse.estimator import ImpulseModel
from ml.ope.linear.estimator import LinearConfig
from ml.ope.scale import learn_scale
from ml.policies.policy import ConstantPolicy
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory

WINDOW, STEPS = 10, 300


def session(i: int, visit: int, rng: np.random.Generator, hold: int, gains: np.ndarray, shape: str) -> SessionTrajectory:
    """Simulate a random session of log beta with a known impulse response to f(a), a level of its own and an autoregression of order 1."""
    draws = rng.uniform(0.3, 1.0, STEPS // hold + 1)
    a = np.repeat(draws, hold)[:STEPS]
    f = dose(shape, np.concatenate([np.full(len(gains), a[0]), a]))
    answer = np.array([f[len(gains) + t - np.arange(len(gains))] @ gains for t in range(-WINDOW, STEPS)])
    noise, eta = rng.standard_normal(WINDOW + STEPS), 0.0
    x = np.empty(WINDOW + STEPS)
    level = 0.1 * rng.standard_normal()
    for t in range(x.size):
        eta = 0.5 * eta + 0.15 * noise[t]
        x[t] = level + answer[t] + eta
    beta = np.exp(x)
    return SessionTrajectory(i + 1, visit, "random", beta[:WINDOW], beta[WINDOW:], a, Qoc(), None, 0.3)


def buffer_of(hold: int, gains: np.ndarray, shape: str = "line", n: int = 16, seed: int = 0) -> ReplayBuffer:
    rng = np.random.default_rng(seed)
    sessions = tuple(session(i, 1 + i // 4, rng, hold, gains, shape) for i in range(n))
    return ReplayBuffer(MdpSettings(xi_beta=1.0, lower_bound=0.3), sessions, "uV", "table")


@pytest.mark.parametrize("shape", SHAPES)
def test_every_dose_shape_runs_from_none_to_cdbs_and_rises(shape: str) -> None:
    a = np.linspace(0.0, 1.0, 101)
    values = dose(shape, a)
    assert values[0] == pytest.approx(0.0, abs=1e-12)
    assert values[-1] == pytest.approx(1.0, abs=1e-12)
    assert (np.diff(values) > 0).all()


def test_means_over_stretches_of_lags_are_those_of_the_definition() -> None:
    signal = np.random.default_rng(1).random(40)
    padded = np.concatenate([np.full(MEMORY, signal[0]), signal])
    expected = [[padded[MEMORY + t - np.arange(EDGES[k], EDGES[k + 1])].mean() for k in range(STRETCHES)] for t in range(signal.size)]
    assert np.allclose(lagged_means(signal), expected, atol=1e-12)
    running = LaggedMeans(signal[:1], signal.size)
    assert np.allclose([running.step(signal[t : t + 1])[0] for t in range(signal.size)], expected, atol=1e-12)


@pytest.mark.parametrize("alpha", ALPHAS)
def test_the_prior_is_the_stable_spline_with_a_sustained_answer_of_variance_one(alpha: float) -> None:
    root = prior_root(alpha)
    slow = root[:, :-1] @ root[:, :-1].T
    assert slow.sum() == pytest.approx(1.0)
    lags = np.arange(MEMORY)
    kernel = alpha ** np.maximum.outer(lags, lags)
    first = kernel[: EDGES[1], : EDGES[1]].sum() / kernel.sum()
    assert slow[0, 0] == pytest.approx(first)
    assert np.count_nonzero(root[:, -1]) == 1


@pytest.mark.parametrize(("gains", "hold"), [(np.array([-0.8]), 1), (-0.8 * (1 - 0.9) * 0.9 ** np.arange(80), 15)], ids=["at once", "slow"])
def test_the_sustained_answer_of_known_sessions_is_found(gains: np.ndarray, hold: int) -> None:
    buffer = buffer_of(hold, gains)
    scale = learn_scale(buffer)
    assert scale.log
    found = fit_impulse(buffer, [ResponseTable.of(s, scale) for s in buffer.sessions], 200, 0)
    low, middle, high = np.percentile(found.sustained * scale.beta_std, [2.5, 50, 97.5])
    assert low <= gains.sum() <= high
    assert middle == pytest.approx(gains.sum(), abs=0.2)
    assert high - low < 0.6


def test_the_evidence_prefers_the_dose_shape_that_made_the_data() -> None:
    buffer = buffer_of(15, -0.9 * (1 - 0.8) * 0.8 ** np.arange(60), shape="threshold", n=24)
    scale = learn_scale(buffer)
    found = fit_impulse(buffer, [ResponseTable.of(s, scale) for s in buffer.sessions], 100, 0)
    by_shape = {shape: sum(w for (s, _), w in found.evidence.items() if s == shape) for shape in SHAPES}
    assert sum(by_shape.values()) == pytest.approx(1.0)
    assert max(by_shape, key=lambda s: by_shape[s]) == "threshold"


def test_amplitudes_that_never_stay_leave_the_slow_answer_open() -> None:
    """Intervals stay wide for what the data leave open: that of a sustained dose is wider where draws change at every step."""
    gains = -0.8 * (1 - 0.97) * 0.97 ** np.arange(160)

    def width(hold: int) -> float:
        buffer = buffer_of(hold, gains, n=8)
        scale = learn_scale(buffer)
        found = fit_impulse(buffer, [ResponseTable.of(s, scale) for s in buffer.sessions], 200, 0)
        low, high = np.percentile(found.sustained * scale.beta_std, [5, 95])
        return float(high - low)

    assert width(1) > 1.3 * width(30)


def test_a_policy_that_repeats_what_was_done_gets_back_what_was_observed() -> None:
    rng = np.random.default_rng(3)
    sessions = []
    for i in range(4):
        made = session(i, 1 + i // 2, rng, 1, np.array([-0.5]), "line")
        a = np.full(STEPS, 0.7)
        sessions.append(SessionTrajectory(i + 1, made.visit, "other", made.lead_beta, made.beta, a, Qoc(), None, None))
    mixed = [session(4 + i, 3, rng, 5, np.array([-0.5]), "line") for i in range(3)]
    buffer = ReplayBuffer(MdpSettings(xi_beta=1.0, lower_bound=0.3), (*sessions, *mixed), "uV", "table")
    fitted = ImpulseModel(LinearConfig(draws=20)).fit(buffer)
    replayed = fitted.replay([ConstantPolicy(0.7)], fitted.main, fitted.end, STEPS)
    for i, own in enumerate(sessions):
        assert np.allclose(replayed.beta[0, :, i], own.beta.mean(), rtol=1e-6)


def test_more_stimulation_lowers_the_predicted_beta_where_it_does() -> None:
    fitted = ImpulseModel(LinearConfig(draws=30)).fit(buffer_of(10, -0.8 * 0.2 * 0.8 ** np.arange(40)))
    found = fitted.evaluate({"low": ConstantPolicy(0.3), "high": ConstantPolicy(0.95)}, 200)
    assert found["high"].predicted["mean_beta"] < found["low"].predicted["mean_beta"]
    assert found["low"].low < found["low"].value < found["low"].high
