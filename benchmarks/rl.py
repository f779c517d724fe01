"""Training and decision speed of `ml.rl`: CPU seconds, one thread, peers timed in turn within the same run.

    python benchmarks/rl.py [--steps N] [--repeats N] [--six]

`ddpg_vs_eager`: one DDPG update of `ml.rl.algorithms.ddpg` against the loop as usually written in PyTorch (below), 400x300, batches of
64 and 256.
`six_vs_eager`: six policies side by side against six such loops, batch 64.
`--six` trains six policies for 10 000 updates at batch 64 in two processes of three and distils them; wall and CPU seconds.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from support.results import run_benchmark
from torch import nn

from ml.mdp import MdpSettings
from ml.policies.onnx_policy import OnnxPolicy
from ml.rl import STUDENT_HIDDEN, TEACHER_HIDDEN, DistilConfig, MlpPolicy, distil, train_many
from ml.rl.algorithms.ddpg import DdpgConfig, DdpgLearner
from ml.rl.kernels.batches import BLOCK, PackedTransitions, RewardScale, batch_indices
from ml.rl.kernels.networks import Critic
from ml.trajectories import ReplayBuffer, SessionTrajectory

WINDOW, ROWS, GAMMA, TAU = 10, 100_000, 0.99, 0.005
BATCHES = (64, 256)
SIX_BATCH = 64
SIX_UPDATES = 10_000


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


def own_stepper(data: dict[str, Any], batch: int, members: int = 1) -> Callable[[], None]:
    """Make the function for one update of each of `members` policies, with the drawing of their batches."""
    packed = PackedTransitions(data["s"], data["a"][:, 0], data["r"][:, 0], data["s2"])
    starts = [{"policy": MlpPolicy(WINDOW, seed=k), "critic": Critic(WINDOW, seed=k)} for k in range(members)]
    configs = [DdpgConfig(tau=TAU, batch=batch, seed=k) for k in range(members)]
    learner = DdpgLearner(starts, configs, RewardScale(0.0, 1.0, GAMMA))
    state: dict[str, Any] = {"count": 0, "rows": None}

    def step() -> None:
        block, row = divmod(state["count"], BLOCK)
        if row == 0:
            state["rows"] = torch.stack([batch_indices(k, block, ROWS, batch) for k in range(members)], dim=1)
        learner.update(packed.take(state["rows"][row]))
        state["count"] += 1

    return step


def cpu_ms(step: Callable[[], None], steps: int) -> float:
    """Measure CPU milliseconds per call."""
    start = time.process_time()
    for _ in range(steps):
        step()
    return (time.process_time() - start) / steps * 1e3


def in_turn(steppers: dict[str, Callable[[], None]], steps: int, repeats: int) -> dict[str, float]:
    """Measure the median CPU milliseconds per update of each stepper; they take turns, so that a busy machine is busy for all."""
    for step in steppers.values():
        cpu_ms(step, max(steps // 4, 5))
    times: dict[str, list[float]] = {name: [] for name in steppers}
    for _ in range(repeats):
        for name, step in steppers.items():
            times[name].append(cpu_ms(step, steps))
    return {name: statistics.median(values) for name, values in times.items()}


def decision_us(act: Callable[[Any], Any], repeats: int = 1000) -> dict[str, float]:
    """Measure the median and 99th percentile of the CPU time of one decision, microseconds."""
    state = np.random.default_rng(0).normal(size=(1, WINDOW))
    times = []
    for i in range(repeats + 200):
        start = time.thread_time_ns()
        act(state)
        if i >= 200:
            times.append((time.thread_time_ns() - start) / 1e3)
    return {"median_us": float(np.median(times)), "p99_us": float(np.quantile(times, 0.99))}


def random_sessions(count: int = 9, steps: int = 300) -> ReplayBuffer:
    """Make sessions of a random controller on a participant whose beta falls with the amplitude; their content does not change the
    speed."""
    rng = np.random.default_rng(0)
    sessions = []
    for i in range(count):
        amplitude = rng.uniform(0.3, 1, steps)
        beta = 200 * np.exp(0.3 * rng.standard_normal(steps) - amplitude)
        sessions.append(SessionTrajectory(i, 1, "random", np.full(WINDOW, 120.0), beta, amplitude, random_bound=0.3))
    return ReplayBuffer(MdpSettings(xi_beta=100.0), tuple(sessions), "uV", "table")


def train_and_distil(seeds: tuple[int, ...]) -> float:
    """Train policies of these seeds side by side, then distil each; CPU seconds of this process."""
    buffer = random_sessions()
    configs = [DdpgConfig(updates=SIX_UPDATES, batch=SIX_BATCH, seed=seed, actor_lr=10.0 ** -(3 + seed / 5)) for seed in seeds]
    for trained in train_many(buffer, configs):
        distil(trained.policy, buffer, DistilConfig(seed=trained.seed))
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def six_policies() -> dict[str, float]:
    """Train six policies x 10 000 updates and their distillation in two processes of three."""
    start = time.perf_counter()
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        cpu = pool.map(train_and_distil, [(0, 1, 2), (3, 4, 5)], chunksize=1)
    timing = {"wall_s": time.perf_counter() - start, "cpu_s": sum(cpu)}
    print(
        f"six policies x {SIX_UPDATES} updates and distillation: {timing['wall_s']:.0f} s wall, {timing['cpu_s']:.0f} s CPU in 2 processes"
    )
    return timing


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=50, help="updates per timing")
    parser.add_argument("--repeats", type=int, default=7, help="timings per peer")
    parser.add_argument("--quick", action="store_true", help="few updates and repeats, for a first look")
    parser.add_argument("--six", action="store_true", help="train and distil six policies; takes minutes")
    options = parser.parse_args()
    if options.quick:
        options.steps, options.repeats = 15, 3
    torch.set_num_threads(1)
    torch.manual_seed(0)
    data = {"s": torch.randn(ROWS, WINDOW), "a": torch.rand(ROWS, 1), "r": torch.randn(ROWS, 1), "s2": torch.randn(ROWS, WINDOW)}
    figures: dict[str, Any] = {}
    ratios: dict[str, float] = {}
    print(f"{'DDPG 400x300':<34}{'batch':>6}{'CPU ms/update':>16}{'updates/s':>12}")
    for batch in BATCHES:
        eager = EagerDdpg(data)
        steppers = {"eager": lambda eager=eager, batch=batch: eager.step(batch), "ours": own_stepper(data, batch)}
        if batch == SIX_BATCH:
            steppers["six of ours"] = own_stepper(data, batch, 6)
        medians = in_turn(steppers, options.steps, options.repeats)
        for name, ms in medians.items():
            each = ms / 6 if name == "six of ours" else ms  # per policy
            figures[f"{name.replace(' ', '_')}_batch{batch}_ms"] = ms
            print(f"{name + ' (each)' * (each != ms):<34}{batch:>6}{each:>16.2f}{1e3 / each:>12.0f}")
        ratios[f"ddpg_vs_eager_batch{batch}"] = medians["eager"] / medians["ours"]
        if batch == SIX_BATCH:
            ratios["six_vs_eager"] = 6 * medians["eager"] / medians["six of ours"]
    for name, ratio in ratios.items():
        print(f"{name:<34}{ratio:>6.2f}")
    if options.six:
        figures["six"] = six_policies()

    print(f"\n{'one decision':<34}{'median us':>12}{'p99 us':>12}")
    for size, hidden in (("teacher", TEACHER_HIDDEN), ("student", STUDENT_HIDDEN)):
        policy = MlpPolicy(WINDOW, hidden)
        for runtime, act in (("torch", policy.act), ("onnxruntime", OnnxPolicy(policy.to_onnx()).act)):
            timing = figures[f"{size}_{runtime}"] = decision_us(act)
            print(f"{size + ', ' + runtime:<34}{timing['median_us']:>12.1f}{timing['p99_us']:>12.1f}")
    ratios["student_vs_teacher_onnxruntime"] = figures["teacher_onnxruntime"]["median_us"] / figures["student_onnxruntime"]["median_us"]

    print(json.dumps({"name": "rl", "figures": figures, "ratios": ratios, "baseline": "eager PyTorch DDPG"}))


if __name__ == "__main__":
    run_benchmark(main)
