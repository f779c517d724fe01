"""Training and decision speed of `ml.rl`: CPU seconds, one thread, peers timed in turn within the same run.

    python benchmarks/rl.py [--steps N] [--repeats N]

`fused_vs_eager`: one DDPG update of `ml.rl.actor_critic` against the loop as usually written in PyTorch (below), 400x300, batch 64 and 256.
`ddpg_vs_d3rlpy`: the same against d3rlpy's DDPG, where d3rlpy is installed (the `bench` extra).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import nn

from ml.rl.actor_critic import DdpgConfig, DdpgLearner
from ml.rl.networks import STUDENT_HIDDEN, TEACHER_HIDDEN, Critic, MlpPolicy
from ml.rl.onnx_policy import OnnxPolicy
from ml.rl.training import PackedTransitions, RewardScale, batch_indices

WINDOW, ROWS, GAMMA, TAU = 10, 100_000, 0.99, 0.005
BATCHES = (64, 256)


class EagerDdpg:
    """DDPG as usually written: one tensor per field, default Adam, targets moved one by one, the actor's loss sent back through all."""

    def __init__(self, data: dict[str, Any]) -> None:
        self.data = data
        self.actor = self._network(WINDOW, nn.Tanh())
        self.critic = self._network(WINDOW + 1)
        self.actor_target, self.critic_target = self._network(WINDOW, nn.Tanh()), self._network(WINDOW + 1)
        self.actor_target.load_state_dict(self.actor.state_dict())
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.actor_adam = torch.optim.Adam(self.actor.parameters(), lr=1e-4)
        self.critic_adam = torch.optim.Adam(self.critic.parameters(), lr=1e-3)

    @staticmethod
    def _network(inputs: int, last: nn.Module | None = None) -> nn.Sequential:
        a, b = TEACHER_HIDDEN
        tail = [last] if last else []
        return nn.Sequential(nn.Linear(inputs, a), nn.ReLU(), nn.Linear(a, b), nn.ReLU(), nn.Linear(b, 1), *tail)

    def step(self, batch: int) -> None:
        index = torch.randint(0, ROWS, (batch,))
        s, a, r, s2 = (self.data[name][index] for name in ("s", "a", "r", "s2"))
        with torch.no_grad():
            target = r + GAMMA * self.critic_target(torch.cat([s2, self.actor_target(s2)], 1))
        loss = nn.functional.mse_loss(self.critic(torch.cat([s, a], 1)), target)
        self.critic_adam.zero_grad()
        loss.backward()
        self.critic_adam.step()
        actor_loss = -self.critic(torch.cat([s, self.actor(s)], 1)).mean()
        self.actor_adam.zero_grad()
        actor_loss.backward()
        self.actor_adam.step()
        with torch.no_grad():
            for target_net, net in ((self.actor_target, self.actor), (self.critic_target, self.critic)):
                for old, new in zip(target_net.parameters(), net.parameters(), strict=True):
                    old.mul_(1 - TAU).add_(TAU * new)


def fused_stepper(data: dict[str, Any], batch: int) -> Callable[[], None]:
    """One update of ours, with the drawing of its batch."""
    packed = PackedTransitions(data["s"], data["a"][:, 0], data["r"][:, 0], data["s2"])
    learner = DdpgLearner(MlpPolicy(WINDOW), Critic(WINDOW), DdpgConfig(tau=TAU, batch=batch), RewardScale(0.0, 1.0, GAMMA))
    state: dict[str, Any] = {"count": 0, "rows": None}

    def step() -> None:
        block, row = divmod(state["count"], 256)
        if row == 0:
            state["rows"] = batch_indices(0, block, ROWS, batch)
        learner.update(packed.take(state["rows"][row]))
        state["count"] += 1

    return step


def d3rlpy_stepper(data: dict[str, Any], batch: int) -> Callable[[], None]:
    """d3rlpy's DDPG: sampling and update, without its logging."""
    import d3rlpy

    rows = 300
    episodes = [
        d3rlpy.dataset.Episode(*(data[k][i : i + rows].numpy() for k in ("s", "a", "r")), terminated=False) for i in range(0, ROWS, rows)
    ]
    buffer = d3rlpy.dataset.ReplayBuffer(d3rlpy.dataset.InfiniteBuffer(), episodes=episodes)
    factory = d3rlpy.models.VectorEncoderFactory(hidden_units=list(TEACHER_HIDDEN))
    algo = d3rlpy.algos.DDPGConfig(
        batch_size=batch, gamma=GAMMA, tau=TAU, actor_encoder_factory=factory, critic_encoder_factory=factory
    ).create(device="cpu:0")
    algo.build_with_dataset(buffer)
    return lambda: algo.update(buffer.sample_transition_batch(batch)) and None


def cpu_ms(step: Callable[[], None], steps: int) -> float:
    """CPU milliseconds per call."""
    start = time.process_time()
    for _ in range(steps):
        step()
    return (time.process_time() - start) / steps * 1e3


def in_turn(steppers: dict[str, Callable[[], None]], steps: int, repeats: int) -> dict[str, float]:
    """Median CPU milliseconds per update of each stepper; they take turns, so that a busy machine is busy for all."""
    for step in steppers.values():
        cpu_ms(step, max(steps // 4, 5))
    times: dict[str, list[float]] = {name: [] for name in steppers}
    for _ in range(repeats):
        for name, step in steppers.items():
            times[name].append(cpu_ms(step, steps))
    return {name: statistics.median(values) for name, values in times.items()}


def product_floor_ms(batch: int) -> float:
    """CPU milliseconds of the matrix products of one update alone, at the rate that the largest of them reaches at this batch."""
    a, b = TEACHER_HIDDEN
    network = WINDOW * a + a * b + b
    # Forward: both targets, critic twice, actor once. Backward: critic by weights and by its last two layers' inputs; the actor's step goes
    # through the critic's last layer, then through the actor by weights and inputs.
    macs = batch * (5 * network + (network + a * b + b) + b + (network + a * b + b))
    left, right, out = torch.rand(batch, a), torch.rand(a, b), torch.empty(batch, b)
    rate = 2 * batch * a * b / (cpu_ms(lambda: _product(left, right, out), 300) * 1e-3)
    return 2 * macs / rate * 1e3


def _product(left: Any, right: Any, out: Any) -> None:
    torch.mm(left, right, out=out)


def decision_us(act: Callable[[Any], Any], repeats: int = 1000) -> dict[str, float]:
    """Median and 99th percentile of the CPU time of one decision, microseconds."""
    state = np.random.default_rng(0).normal(size=(1, WINDOW))
    times = []
    for i in range(repeats + 200):
        start = time.thread_time_ns()
        act(state)
        if i >= 200:
            times.append((time.thread_time_ns() - start) / 1e3)
    return {"median_us": float(np.median(times)), "p99_us": float(np.quantile(times, 0.99))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=50, help="updates per timing")
    parser.add_argument("--repeats", type=int, default=7, help="timings per peer")
    parser.add_argument("--quick", action="store_true", help="few updates and repeats, for a first look")
    options = parser.parse_args()
    if options.quick:
        options.steps, options.repeats = 15, 3
    torch.set_num_threads(1)
    torch.manual_seed(0)
    data = {"s": torch.randn(ROWS, WINDOW), "a": torch.rand(ROWS, 1), "r": torch.randn(ROWS, 1), "s2": torch.randn(ROWS, WINDOW)}
    has_d3rlpy = importlib.util.find_spec("d3rlpy") is not None

    figures: dict[str, Any] = {}
    ratios: dict[str, float] = {}
    print(f"{'DDPG 400x300':<22}{'batch':>6}{'CPU ms/update':>16}{'updates/s':>12}{'of floor':>10}")
    for batch in BATCHES:
        eager = EagerDdpg(data)
        steppers = {"eager": lambda eager=eager, batch=batch: eager.step(batch), "fused": fused_stepper(data, batch)}
        if has_d3rlpy:
            steppers["d3rlpy"] = d3rlpy_stepper(data, batch)
        medians = in_turn(steppers, options.steps, options.repeats)
        floor = product_floor_ms(batch)
        for name, ms in medians.items():
            figures[f"{name}_batch{batch}_ms"] = ms
            print(f"{name:<22}{batch:>6}{ms:>16.2f}{1e3 / ms:>12.0f}{floor / ms:>10.0%}")
        figures[f"floor_batch{batch}_ms"] = floor
        ratios[f"fused_vs_eager_batch{batch}"] = medians["eager"] / medians["fused"]
        if has_d3rlpy:
            ratios[f"ddpg_vs_d3rlpy_batch{batch}"] = medians["d3rlpy"] / medians["fused"]
    ratios["fused_vs_eager"] = ratios["fused_vs_eager_batch64"]
    if has_d3rlpy:
        ratios["ddpg_vs_d3rlpy"] = ratios["ddpg_vs_d3rlpy_batch256"]
    else:
        print("d3rlpy is not installed (the `bench` extra): no ddpg_vs_d3rlpy")

    print(f"\n{'one decision':<34}{'median us':>12}{'p99 us':>12}")
    for size, hidden in (("teacher", TEACHER_HIDDEN), ("student", STUDENT_HIDDEN)):
        policy = MlpPolicy(WINDOW, hidden)
        for runtime, act in (("torch", policy.act), ("onnxruntime", OnnxPolicy(policy.to_onnx()).act)):
            timing = figures[f"{size}_{runtime}"] = decision_us(act)
            print(f"{size + ', ' + runtime:<34}{timing['median_us']:>12.1f}{timing['p99_us']:>12.1f}")
    ratios["student_vs_teacher_onnxruntime"] = figures["teacher_onnxruntime"]["median_us"] / figures["student_onnxruntime"]["median_us"]

    baseline = "eager PyTorch DDPG" + ("; d3rlpy DDPG" if has_d3rlpy else "; d3rlpy is not installed")
    print(json.dumps({"name": "rl", "figures": figures, "ratios": ratios, "baseline": baseline}))


if __name__ == "__main__":
    main()
