from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm

from ml.mdp import MdpSettings
from ml.rl import MlpPolicy, TrainedPolicy, TrainingDiverged, train
from ml.rl.algorithms.ddpg import DdpgConfig, DdpgLearner
from ml.rl.kernels.batches import RewardScale, TransitionBatch, batch_indices, packed
from ml.rl.kernels.networks import Critic
from ml.rl.kernels.stacked import into_module

SMALL = DdpgConfig(hidden=(16, 12), updates=60, batch=16, record_every=10, checkpoint_every=7, actor_lr=1e-3)


def weights(network):
    return [p.detach().clone() for p in network.parameters()]


def same(left, right):
    return all(torch.equal(a, b) for a, b in zip(left, right, strict=True))


# --- known answers ------------------------------------------------------------------------------------------------------------------


def test_without_a_future_ddpg_finds_the_amplitude_that_balances_threshold_and_price(make_buffer):
    settings = MdpSettings(xi_beta=120.0, c1=0.7, gamma=0.0)
    buffer = make_buffer(settings, count=6, steps=500, noise=0.1)
    amplitudes = np.linspace(0, 1, 1001)
    # The sessions' beta is 200 exp(0.1 n - a) with n standard normal: probability of reaching the threshold in closed form.
    reward = -norm.sf((np.log(settings.xi_beta / 200) + amplitudes) / 0.1) - settings.c1 * amplitudes
    best = amplitudes[reward.argmax()]
    trained = train(buffer, DdpgConfig(actor_lr=1e-3, hidden=(64, 64), updates=2000, batch=128, seed=0))
    chosen = trained.policy.act(buffer.transitions().states).mean()
    assert abs(chosen - best) < 0.07
    assert reward.max() - np.interp(chosen, amplitudes, reward) < 0.04
    assert trained.curve["mean_q"][-1] == pytest.approx(reward.max(), abs=0.08)


# --- the slow twin ------------------------------------------------------------------------------------------------------------------


class Net:
    """A multi-layer perceptron in plain loops: forward and backward for one row, float64."""

    def __init__(self, network):
        layers, join = network.layers, 1 if isinstance(network, Critic) else None
        self.w = [layer.weight.detach().double().tolist() for layer in layers]
        if join:
            self.w[join] = torch.cat([layers[join].weight, network.action.weight], dim=1).detach().double().tolist()
        self.b = [layer.bias.detach().double().tolist() for layer in layers]
        self.join = join  # layer whose input gets the action appended

    def forward(self, x, action=None):
        x, inputs, outputs = list(x), [], []
        for i, (rows, bias) in enumerate(zip(self.w, self.b, strict=True)):
            if i == self.join:
                x = [*x, 2 * action - 1]
            inputs.append(x)
            x = [sum(w * v for w, v in zip(row, x, strict=True)) + b for row, b in zip(rows, bias, strict=True)]
            outputs.append(x)
            if i < len(self.w) - 1:
                x = [max(v, 0.0) for v in x]
        return x[0], (inputs, outputs)

    def backward(self, memory, slope):
        """Compute the gradient of slope * output by each weight and bias, and by the action."""
        inputs, outputs = memory
        grad_w, grad_b, by_action, delta = [None] * len(self.w), [None] * len(self.w), 0.0, [slope]
        for i in reversed(range(len(self.w))):
            if i < len(self.w) - 1:
                delta = [d if z > 0 else 0.0 for d, z in zip(delta, outputs[i], strict=True)]
            grad_w[i] = [[d * v for v in inputs[i]] for d in delta]
            grad_b[i] = list(delta)
            delta = [sum(d * row[j] for d, row in zip(delta, self.w[i], strict=True)) for j in range(len(inputs[i]))]
            if i == self.join:
                by_action = 2 * delta.pop()
        return grad_w, grad_b, by_action

    def flat(self):
        return np.array([v for w, b in zip(self.w, self.b, strict=True) for v in [*(x for row in w for x in row), *b]])

    def set_flat(self, values):
        values = iter(values)
        for w, b in zip(self.w, self.b, strict=True):
            for row in w:
                row[:] = [next(values) for _ in row]
            b[:] = [next(values) for _ in b]


def flatten(grad_w, grad_b):
    return np.array([v for w, b in zip(grad_w, grad_b, strict=True) for v in [*(x for row in w for x in row), *b]])


class Adam:
    def __init__(self, lr, decay=0.0):
        self.lr, self.decay, self.m, self.v, self.t = lr, decay, 0.0, 0.0, 0

    def step(self, theta, gradient):
        gradient = gradient + self.decay * theta
        self.t += 1
        self.m = 0.9 * self.m + 0.1 * gradient
        self.v = 0.999 * self.v + 0.001 * gradient**2
        return theta - self.lr * (self.m / (1 - 0.9**self.t)) / (np.sqrt(self.v / (1 - 0.999**self.t)) + 1e-8)


def bound(x):
    return (math.tanh(x) + 1) / 2


class SlowDdpg:
    """DDPG row by row, from the text of Lillicrap et al., algorithm 1."""

    def __init__(self, policy, critic, config, gamma):
        self.pi, self.q = Net(policy), Net(critic)
        self.pi_target, self.q_target = Net(policy), Net(critic)
        self.config, self.gamma = config, gamma
        self.actor_adam, self.critic_adam = Adam(config.actor_lr), Adam(config.critic_lr, config.critic_weight_decay)

    def update(self, rows):
        n = len(rows)
        gradient = 0.0
        for s, a, r, s2 in rows:
            y = r + self.gamma * self.q_target.forward(s2, bound(self.pi_target.forward(s2)[0]))[0]
            q, memory = self.q.forward(s, a)
            gradient = gradient + flatten(*self.q.backward(memory, 2 * (q - y) / n)[:2])
        self.q.set_flat(self.critic_adam.step(self.q.flat(), gradient))
        gradient = 0.0
        for s, *_ in rows:
            x, memory = self.pi.forward(s)
            by_action = self.q.backward(self.q.forward(s, bound(x))[1], 1.0)[2]
            gradient = gradient + flatten(*self.pi.backward(memory, -by_action * 0.5 * (1 - math.tanh(x) ** 2) / n)[:2])
        self.pi.set_flat(self.actor_adam.step(self.pi.flat(), gradient))
        for target, online in ((self.q_target, self.q), (self.pi_target, self.pi)):
            target.set_flat((1 - self.config.tau) * target.flat() + self.config.tau * online.flat())


@pytest.mark.parametrize("decay", [0.0, 0.01])
def test_an_update_equals_the_slow_twin_in_plain_loops(decay):
    config = DdpgConfig(hidden=(6, 5), batch=8, tau=0.1, actor_lr=1e-3, critic_lr=2e-3, critic_weight_decay=decay)
    policy, critic = MlpPolicy(3, (6, 5), seed=1), Critic(3, (6, 5), seed=2)
    with torch.no_grad():  # last layers as after some training, so that every gradient is far from Adam's epsilon
        policy.layers[-1].weight.mul_(100)
        critic.layers[-1].weight.mul_(100)
    learner = DdpgLearner([{"policy": policy, "critic": critic}], [config], RewardScale(0.0, 1.0, 0.95))
    twin = SlowDdpg(policy, critic, config, 0.95)
    start = twin.pi.flat()
    rng = np.random.default_rng(0)
    for _ in range(5):
        s, a, r, s2 = (rng.normal(size=(8, 3)), rng.uniform(size=8), rng.normal(size=8), rng.normal(size=(8, 3)))
        columns = (s, a[:, None], r[:, None], s2, a[:, None], a[:, None])
        learner.update(TransitionBatch(*(torch.tensor(x, dtype=torch.float32)[None] for x in columns)))
        twin.update(list(zip(s, a, r, s2, strict=True)))
    assert np.abs(twin.pi.flat() - start).max() > 4e-3, "the updates must move the weights"
    for fast, slow, module in (
        (learner.stacks["policy"], twin.pi, policy),
        (learner.stacks["critic"], twin.q, critic),
        (learner.target_stacks["policy"], twin.pi_target, policy),
        (learner.target_stacks["critic"], twin.q_target, critic),
    ):
        into_module(fast.weights[0], module)
        np.testing.assert_allclose(Net(module).flat(), slow.flat(), atol=2e-5)


# --- conduct ------------------------------------------------------------------------------------------------------------------------


def test_the_same_buffer_configuration_and_seed_give_the_same_weights_bit_for_bit(buffer):
    one, two = train(buffer, SMALL), train(buffer, SMALL)
    assert one.policy.to_onnx() == two.policy.to_onnx()
    assert same(weights(one.critic), weights(two.critic))
    assert one.curve.keys() == {"update", "critic_loss", "mean_q", "action_distance", "saturated"}
    for name in one.curve:
        np.testing.assert_array_equal(one.curve[name], two.curve[name])


def test_another_seed_gives_another_policy(buffer):
    other = DdpgConfig(**{**SMALL.to_json(), "hidden": (16, 12), "seed": 1})
    assert train(buffer, SMALL).policy.to_onnx() != train(buffer, other).policy.to_onnx()


def test_a_batch_holds_the_buffers_own_rows(buffer):
    transitions = buffer.transitions()
    scale = RewardScale.of(transitions.rewards, 0.99)
    index = torch.stack([batch_indices(seed, 3, transitions.actions.size, 8)[17] for seed in (5, 6)])
    batch = packed(transitions, lambda x: x / 100, scale).take(index)
    rows = index.numpy()
    np.testing.assert_allclose(batch.states, transitions.states[rows] / 100, rtol=1e-6)
    np.testing.assert_allclose(batch.next_states, transitions.next_states[rows] / 100, rtol=1e-6)
    np.testing.assert_allclose(batch.actions[..., 0], transitions.actions[rows], rtol=1e-6)
    np.testing.assert_allclose(batch.rewards[..., 0] / scale.factor + scale.shift, transitions.rewards[rows], atol=1e-6)


def test_the_next_logged_action_is_known_within_a_session_and_unknown_at_its_end_and_at_gaps(make_buffer):
    buffer = make_buffer(MdpSettings(xi_beta=100.0), count=2, steps=6)
    buffer.sessions[0].amplitude[3] = np.nan  # steps 0-2, 4-5 stay
    transitions = buffer.transitions()
    batch = packed(transitions, lambda x: x, RewardScale(0.0, 1.0, 0.9)).take(torch.arange(11)[None])
    logged = torch.tensor(np.concatenate([s.amplitude for s in buffer.sessions]), dtype=torch.float32).tolist()
    assert batch.next_known[0, :, 0].tolist() == [1, 1, 0, 1, 0, 1, 1, 1, 1, 1, 0]
    assert batch.next_actions[0, :, 0].tolist() == pytest.approx([*logged[1:3], 0, logged[5], 0, *logged[7:12], 0])


def test_batches_cover_the_buffer_evenly():
    drawn = np.concatenate([batch_indices(1, block, 50, 64).numpy().ravel() for block in range(8)])
    counts = np.bincount(drawn, minlength=50)
    expected = drawn.size / 50
    assert ((counts - expected) ** 2 / expected).sum() < 90  # chi-squared, 49 degrees of freedom: p about 0.0003


def test_a_value_comes_back_in_the_rewards_own_unit():
    rewards = np.random.default_rng(0).uniform(-1.3, 0, 400)
    scale = RewardScale.of(rewards, 0.9)
    discount = 0.9 ** np.arange(400)
    assert scale.value(float(scale.scaled(rewards) @ discount)) == pytest.approx(float(rewards @ discount))
    assert RewardScale.of(np.full(5, -0.3), 0.99).factor == 1.0


def test_the_torch_threads_are_given_back(buffer):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        train(buffer, DdpgConfig(hidden=(4, 4), updates=2))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_the_curves_last_point_is_that_of_the_policy_that_comes_back(buffer):
    pushed = MlpPolicy(10, (16, 12), mean=100.0, std=40.0)
    with torch.no_grad():
        pushed.layers[-1].weight.mul_(1000)
    trained = train(buffer, DdpgConfig(hidden=(16, 12), updates=20), initial=pushed)
    logged = buffer.transitions()
    actions = trained.policy.act(logged.states)
    assert trained.curve["action_distance"][-1] == pytest.approx(np.abs(actions - logged.actions).mean(), abs=1e-5)
    saturated = np.mean((actions < 0.01) | (actions > 0.99))
    assert 0 < saturated < 1
    assert trained.curve["saturated"][-1] == pytest.approx(saturated, abs=0.01)


def test_a_training_that_diverges_says_so(buffer):
    broken = MlpPolicy(10, (16, 12), mean=100.0, std=40.0)
    with torch.no_grad():
        broken.layers[0].bias.fill_(math.inf)
    with pytest.raises(TrainingDiverged, match=r"critic_loss|mean_q"):
        train(buffer, SMALL, initial=broken)


# --- fine-tuning --------------------------------------------------------------------------------------------------------------------


def test_fine_tuning_goes_on_from_the_policy_and_leaves_it_as_it_was(buffer):
    first = train(buffer, SMALL)
    before = first.policy.to_onnx(), weights(first.critic)
    tuned = train(buffer, DdpgConfig(hidden=(16, 12), actor_lr=1e-6, critic_lr=1e-5, updates=50), initial=first)
    assert (first.policy.to_onnx(), True) == (before[0], same(weights(first.critic), before[1]))
    states = buffer.transitions().states
    moved = np.abs(tuned.policy.act(states) - first.policy.act(states)).max()
    assert 0 < moved < 1e-3


def test_a_policy_without_its_critic_stands_still_while_the_critic_warms_up(buffer):
    policy = MlpPolicy(10, (16, 12), mean=90.0, std=50.0, seed=9)
    config = {"hidden": (16, 12), "updates": 30, "actor_lr": 1e-3}
    assert train(buffer, DdpgConfig(**config, critic_warmup=30), initial=policy).policy.to_onnx() == policy.to_onnx()
    assert train(buffer, DdpgConfig(**config, critic_warmup=29), initial=policy).policy.to_onnx() != policy.to_onnx()


def test_a_stored_training_comes_back_and_is_tuned_to_the_same_weights(buffer):
    first = train(buffer, SMALL)
    back = TrainedPolicy.from_bytes(first.to_bytes())
    assert back.config == SMALL
    assert back.seed == SMALL.seed
    np.testing.assert_array_equal(back.curve["mean_q"], first.curve["mean_q"])
    assert train(buffer, SMALL, initial=back).policy.to_onnx() == train(buffer, SMALL, initial=first).policy.to_onnx()
    with pytest.raises(ValueError, match="no stored weights"):
        TrainedPolicy.from_bytes(b"something else")


def test_an_initial_policy_of_other_sizes_is_refused(buffer):
    with pytest.raises(ValueError, match=r"hidden layers \(4, 4\)"):
        train(buffer, SMALL, initial=MlpPolicy(10, (4, 4)))
    with pytest.raises(ValueError, match="window of 5"):
        train(buffer, SMALL, initial=MlpPolicy(5, (16, 12)))


@pytest.mark.parametrize(
    "wrong",
    [
        {"actor_lr": 0.0},
        {"tau": 2.0},
        {"batch": 0},
        {"hidden": (4,)},
        {"critic_warmup": 99_999},
        {"seed": -1},
        {"critic_weight_decay": -1.0},
    ],
)
def test_impossible_hyper_parameters_are_refused_by_name(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        DdpgConfig(**wrong)


def test_a_configuration_goes_through_json_and_refuses_unknown_names():
    assert DdpgConfig.from_json(SMALL.to_json()) == SMALL
    with pytest.raises(ValueError, match="no hyper-parameter gamma"):
        DdpgConfig.from_json({"gamma": 0.9})
