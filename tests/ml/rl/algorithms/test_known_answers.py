"""Problems whose optimal policy is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from ml.rl import ALGORITHMS
from ml.rl.training import train_on
from ml.trajectories import Transitions

SHARED = {"batch": 128, "hidden": (48, 48), "updates": 2500, "seed": 1, "critic_lr": 2e-3, "tau": 0.02}
SOLVERS = {
    "ddpg": ({"actor_lr": 3e-4}, 0.06, 0.15),
    "td3_bc": ({"actor_lr": 1e-3, "alpha": 40.0}, 0.08, 0.2),
    "rebrac": ({"actor_lr": 1e-3, "actor_penalty": 0.01, "critic_penalty": 0.0}, 0.08, 0.2),
    "iql": ({"actor_lr": 1e-3, "expectile": 0.9, "temperature": 20.0}, 0.12, 0.25),
}
"""Settings that hardly bind the policy to the logged actions (which are uniform here), and how near it must come: mean, worst."""


def linear_quadratic(count=4000, gamma=0.9, keep=0.9, push=0.8, price=0.3, seed=0):
    """Simulate x' = 0.9 x + 0.8 u + noise at cost x^2 + 0.3 u^2, u = a - 0.5: transitions, and the gain K of the optimal u = -K x."""
    rng = np.random.default_rng(seed)
    x, older, action = rng.uniform(-0.8, 0.8, count), rng.uniform(-0.8, 0.8, count), rng.uniform(0, 1, count)
    u = action - 0.5
    following = keep * x + push * u + rng.normal(0, 0.05, count)
    p = 1.0
    for _ in range(500):  # the discounted Riccati equation
        p = 1 + gamma * keep**2 * p - (gamma * keep * push * p) ** 2 / (price + gamma * push**2 * p)
    gain = gamma * keep * push * p / (price + gamma * push**2 * p)
    rows = np.arange(count)
    # Each row is a session of its own: the action logged after it is unknown.
    return Transitions(np.c_[older, x], action, -(x**2) - price * u**2, np.c_[x, following], rows, rows * 0), gain, gamma


@pytest.mark.parametrize("name", sorted(SOLVERS))
def test_it_finds_the_linear_quadratic_regulator(name):
    transitions, gain, gamma = linear_quadratic()
    settings, mean, worst = SOLVERS[name]
    kind = ALGORITHMS[name]
    trained = train_on(transitions, gamma, (0.0, 0.46), [kind.config(**(SHARED | settings))])[0]
    x = np.linspace(-0.5, 0.5, 41)
    optimal = 0.5 - gain * x
    assert np.ptp(optimal) > 0.7, "a problem that a constant would not solve"
    for older in (-0.5, 0.5):  # the optimal action does not depend on the older element
        error = np.abs(trained.policy.act(np.c_[np.full(41, older), x]) - optimal)
        assert error.mean() < mean
        assert error.max() < worst


def test_behaviour_cloning_finds_the_mean_of_the_logged_actions_and_not_the_optimum():
    transitions, gain, gamma = linear_quadratic()
    rng = np.random.default_rng(4)
    logged = np.clip(0.5 + 0.6 * transitions.states[:, 1] + rng.normal(0, 0.1, 4000), 0, 1)
    given = Transitions(*(getattr(transitions, n) if n != "actions" else logged for n in transitions.__dataclass_fields__))
    kind = ALGORITHMS["cloning"]
    config = kind.config(batch=128, hidden=(48, 48), updates=1500, actor_lr=1e-3)
    policy = train_on(given, gamma, (0.0, 0.46), [config])[0].policy
    x = np.linspace(-0.5, 0.5, 41)
    error = np.abs(policy.act(np.c_[np.zeros(41), x]) - (0.5 + 0.6 * x))
    assert error.mean() < 0.03
    assert gain > 0, "the optimal action falls with x, the logged one rises"


@pytest.mark.parametrize("name", ["td3_bc", "rebrac"])
def test_a_strong_bond_to_the_logged_actions_makes_it_clone_them(name):
    transitions, _, gamma = linear_quadratic()
    kind = ALGORITHMS[name]
    bond = {"alpha": 1e-4} if name == "td3_bc" else {"actor_penalty": 1e4}
    config = kind.config(**(SHARED | {"updates": 1200, "actor_lr": 1e-3} | bond))
    policy = train_on(transitions, gamma, (0.0, 0.46), [config])[0].policy
    answers = policy.act(np.c_[np.zeros(21), np.linspace(-0.5, 0.5, 21)])
    assert np.abs(answers - 0.5).mean() < 0.05, "the logged actions are uniform: their mean is 0.5 everywhere"


@pytest.mark.parametrize("name", ["td3_bc", "rebrac"])
def test_a_strong_bond_to_a_constant_amplitude_makes_it_that_constant(name):
    transitions, _, gamma = linear_quadratic()
    kind = ALGORITHMS[name]
    bond = {"alpha": 1e-4} if name == "td3_bc" else {"actor_penalty": 1e4}
    base = SHARED | {"updates": 1200, "actor_lr": 1e-3, "anchor": "constant"} | bond
    levels = (0.8, 0.35)
    configs = [kind.config(**base, anchor_amplitude=level) for level in levels]
    for level, trained in zip(levels, train_on(transitions, gamma, (0.0, 0.46), configs), strict=True):
        answers = trained.policy.act(np.c_[np.zeros(21), np.linspace(-0.5, 0.5, 21)])
        assert np.abs(answers - level).max() < 0.03


@pytest.mark.parametrize("name", ["td3_bc", "rebrac"])
def test_a_bond_between_lets_it_leave_the_constant_as_far_as_the_values_pay_for(name):
    # one step, reward -(a - 0.2)^2 whatever the state: the value is the reward, known in closed form
    rng = np.random.default_rng(6)
    states, action, rows = rng.normal(size=(4000, 2)), rng.uniform(0, 1, 4000), np.arange(4000)
    reward = -((action - 0.2) ** 2)
    transitions = Transitions(states, action, reward, states, rows, rows * 0)
    anchor, strengths = 0.6, (1.0, 3.0)

    def slope(pi, strength):
        """Compute the slope of b (2 pi - 2 anchor)^2 - Q / |Q| with constant |Q|, Q in deviations of the reward."""
        return 8 * strength * (pi - anchor) + 2 * (pi - 0.2) / abs(-((pi - 0.2) ** 2) - reward.mean())

    expected = [brentq(slope, 0.2, 0.55, strength) for strength in strengths]
    assert all(0.25 < e < 0.55 for e in expected), "neither the constant nor the optimum"
    kind = ALGORITHMS[name]
    base = SHARED | {"actor_lr": 1e-3, "anchor": "constant", "anchor_amplitude": anchor}
    bonds = [{"alpha": 1 / s} if name == "td3_bc" else {"actor_penalty": s, "critic_penalty": 0.0} for s in strengths]
    trained = train_on(transitions, 0.0, (0.0, 1.0), [kind.config(**(base | bond)) for bond in bonds])
    assert [t.policy.act(states[:200]).mean() for t in trained] == pytest.approx(expected, abs=0.04)
