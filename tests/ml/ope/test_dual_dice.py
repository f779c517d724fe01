"""DualDICE against the exact density ratios and values of a tabular MDP."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ml.ope.dual_dice import LARGEST_GAP, DiceConfig, DualDice, StackedMlp, flow_gap, ratios, saddle
from ml.policies.policy import ConstantPolicy

GO = np.array([[[0.75, 0.25], [0.5, 0.5]], [[0.25, 0.75], [0.5, 0.5]]])
REWARD = np.array([[1.0, -0.5], [0.2, 2.0]])
GAMMA = 0.8


def chain(target):
    """Repeat every (s, a, s') by its probability, one-hot: inputs now and then under a deterministic target, rewards."""
    now, then, rewards = [], [], []
    for s in range(2):
        for a in range(2):
            for s2 in range(2):
                for _ in range(int(4 * GO[s, a, s2])):
                    now.append(np.eye(4)[2 * s + a])
                    then.append(np.eye(4)[2 * s2 + target[s2]])
                    rewards.append(REWARD[s, a])
    return np.array(now), np.array(then), np.array(rewards)


def exact(target):
    """Compute the normalised discounted distribution over (s, a) of the target from state 0, [4]."""
    p, d = np.array([1.0, 0.0]), np.zeros(4)
    for t in range(400):
        for s in range(2):
            d[2 * s + target[s]] += (1 - GAMMA) * GAMMA**t * p[s]
        p = sum(p[s] * GO[s, target[s]] for s in range(2))
    return d


@pytest.mark.slow
def test_ratios_and_values_of_a_tabular_mdp_are_the_exact_ones_for_two_policies_at_once():
    targets = [np.array([1, 0]), np.array([1, 1])]
    now, then = chain(targets[0])[0], np.stack([chain(t)[1] for t in targets])
    rewards = chain(targets[0])[2]
    first = np.stack([np.eye(4)[[t[0]]] for t in targets])
    config = DiceConfig(members=1, hidden=(), updates=4000, batch=128, learning_rate=0.01)
    zeta = ratios(now, then, first, np.full((1, len(now)), 1 / len(now)), GAMMA, config)[:, 0]
    for k, (target, z) in enumerate(zip(targets, zeta, strict=True)):
        assert flow_gap(z[None], now, then[k], first[k], GAMMA) < LARGEST_GAP
        distribution = exact(target)
        expected = (distribution / 0.25)[now.argmax(1)]
        assert np.abs(z - expected).mean() < 0.12
        assert (z * rewards).sum() / z.sum() == pytest.approx(distribution @ REWARD.ravel(), abs=0.08)


def test_the_stack_computes_what_each_of_its_networks_computes_alone():
    g = torch.Generator().manual_seed(0)
    stack, other = StackedMlp(3, 5, (7, 6), g), StackedMlp(3, 5, (7,), g, 0.5)
    x, then, first = (torch.randn(3, n, 5, generator=g) for n in (11, 11, 4))
    together = saddle(stack(x), stack(then), stack(first), other(x), 0.9)

    def alone(net, k, rows):
        for i, (weight, bias) in enumerate(net.layers):
            rows = torch.nn.functional.linear(rows, weight[k].T, bias[k, 0])
            rows = torch.relu(rows) if i < len(net.layers) - 1 else rows
        return rows[:, 0]

    for k in range(3):
        total = torch.tensor(0.0)
        for row in range(11):
            z = alone(other, k, x[k])[row]
            total = total + (alone(stack, k, x[k])[row] - 0.9 * alone(stack, k, then[k])[row]) * z - 0.5 * z**2
        expected = total / 11 - 0.1 * alone(stack, k, first[k]).mean()
        assert float(together[k].detach()) == pytest.approx(float(expected.detach()), abs=1e-5)


def test_estimates_are_finite_repeatable_and_say_what_they_approximate(small_buffer):
    policies = {"half": ConstantPolicy(0.5), "full": ConstantPolicy(1.0)}
    config = DiceConfig(members=2, updates=60, refits=20)
    one, two = (DualDice(config).fit(small_buffer).evaluate(policies, 40) for _ in range(2))
    assert one == two
    assert "discounted distribution" in one["half"].details["approximations"][0]
    assert one["half"].low <= one["half"].value <= one["half"].high
    assert -1.3 * 34 < one["full"].step_return <= 0


def test_a_report_that_raises_stops_the_fit(small_buffer):
    class Cancelled(Exception):
        pass

    def stop(fraction, message="", **numbers):
        if "density" in message and fraction < 1:
            raise Cancelled

    with pytest.raises(Cancelled):
        DualDice(DiceConfig(updates=500)).fit(small_buffer).evaluate({"half": ConstantPolicy(0.5)}, 40, stop)


def test_ratios_that_training_has_not_reached_are_told_and_speak_for_no_policy(small_buffer):
    """At gamma = 0.99 ratios fall towards 0 long before they find their level: weighted averages look fine, and mean nothing."""
    found = DualDice(DiceConfig(members=1, updates=20)).fit(small_buffer).evaluate({"half": ConstantPolicy(0.5)}, 30)["half"]
    assert found.details["flow_gap"] > LARGEST_GAP
    flag = next(f for f in found.flags if f.code == "not_converged")
    assert (flag.refuses, flag.limit, found.supported) == (True, LARGEST_GAP, False)
    exact_now, exact_then = chain(np.array([1, 0]))[:2]
    exact_zeta = (exact(np.array([1, 0])) / 0.25)[exact_now.argmax(1)]
    assert flow_gap(exact_zeta[None], exact_now, exact_then, np.eye(4)[[1]], GAMMA) < 1e-9
