"""Common part of the algorithms: K policies with their critics and targets side by side, fresh or from an earlier training."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ml.rl.configs import CriticConfig, TrainConfig
from ml.rl.kernels.batches import RewardScale, TransitionBatch
from ml.rl.kernels.networks import Critic, MlpPolicy
from ml.rl.kernels.stacked import Stack, StackedActor, StackedAdam, into_module
from ml.rl.memory import SPANS_S

SATURATION_MARGIN = 0.01
"""An amplitude fraction this near to 0 or 1 counts as saturated."""

Networks = Mapping[str, Any]
"""The networks of one policy by name: `policy`, and the other networks of its algorithm."""
C = TypeVar("C", bound=TrainConfig)


class StackedLearner(abc.ABC, Generic[C]):
    """K members of one algorithm; their starts are copied, never changed.

    Args:
        starts: the networks of each member.
        configs: hyper-parameters of each member; those not in `per_member` are the same in all.
        scale: of the rewards.
        device: `cpu` or `cuda`.
    """

    config_type: ClassVar[type[Any]]
    targets: ClassVar[tuple[str, ...]] = ()
    """Networks that have a slowly following copy."""
    uses_noise: bool = False

    def __init__(self, starts: Sequence[Networks], configs: Sequence[C], scale: RewardScale, device: str = "cpu") -> None:
        self.configs, self.scale, self.device = tuple(configs), scale, device
        self.config = configs[0]
        self.members = len(configs)
        self._starts = starts
        self.policy_stack = StackedActor([start["policy"] for start in starts], self.config.batch, device)
        self.stacks: dict[str, Stack] = {"policy": self.policy_stack}
        shared: Stack | None = None
        for name in [name for name in starts[0] if name != "policy"]:
            self.stacks[name] = Stack([start[name] for start in starts], self.config.batch, device)
            shared = shared or self.stacks[name]
        # Targets answer before anything that is differentiated, so they may use the memory of a critic of the same sizes.
        self.target_stacks = {name: self._copy(name, starts, shared) for name in self.targets if name != "policy"}
        if "policy" in self.targets:
            self.target_actor = StackedActor([start["policy"] for start in starts], self.config.batch, device, shares=shared)
            self.target_stacks["policy"] = self.target_actor
        self.adams = {name: self._adam(name) for name in self.stacks}
        # On the device once: hyper-parameters of each member as factors of its losses.
        self._settings = {name: self._per_member(name) for name in self.config.per_member if name != "seed"}
        self._updates = self._since_measure = 0
        self._sums: dict[str, Any] = {}

    @classmethod
    @abc.abstractmethod
    def networks(cls, config: C, policy: MlpPolicy, seeds: Sequence[int]) -> dict[str, nn.Module]:
        """Make a policy and fresh other networks; `seeds` has enough for them."""

    @abc.abstractmethod
    def update(self, batch: TransitionBatch) -> None:
        """Run one update, in the order of the module's text."""

    def measure(self, probe: TransitionBatch) -> list[dict[str, float]]:
        """Compute points of the learning curves of each member, as `TrainedPolicy.curve` describes them."""
        actions = self.policy_stack.act(probe.states)
        values = self._probe_values(probe.critic_states, actions)
        distance = (actions - probe.actions).abs().mean(dim=(1, 2)).tolist()
        saturated = ((actions - 0.5).abs() > 0.5 - SATURATION_MARGIN).double().mean(dim=(1, 2)).tolist()
        means = {name: (total / max(self._since_measure, 1)).tolist() for name, total in self._sums.items()}
        self._sums.clear()
        self._since_measure = 0
        points = []
        for k in range(self.members):
            losses = {name: self._in_reward_units(name, mean[k]) for name, mean in means.items()}
            mean_q = {} if values is None else {"mean_q": self.scale.value(values[k])}
            points.append(losses | mean_q | {"action_distance": distance[k], "saturated": saturated[k]})
        return points

    def policy(self, member: int) -> MlpPolicy:
        """Copy the current state of one policy."""
        return self.modules(self.rows(member))["policy"]

    def start_values(self, states: NDArray[np.float64], memory: NDArray[np.float64]) -> list[float] | None:
        """Average Q(s, pi(s)) over beta windows [n, W] for each member, in reward units; None for an algorithm without a critic.

        `memory`, [n, M], is a further input of critics that remember past amplitudes.
        """
        windows = torch.tensor(states, dtype=torch.float32)
        scores = self._starts[0]["policy"].normalise(windows).to(self.device).expand(self.members, -1, -1)
        seen = scores
        if remembers(self.config):
            seen = torch.cat([scores, torch.tensor(memory, dtype=torch.float32, device=self.device).expand(self.members, -1, -1)], dim=2)
        values = self._probe_values(seen, self.policy_stack.act(scores))
        return None if values is None else [self.scale.value(value) for value in values]

    def rows(self, member: int) -> dict[str, Any]:
        """Copy one member's weights, by network."""
        return {name: stack.weights[member].cpu().clone() for name, stack in self.stacks.items()}

    def modules(self, rows: Mapping[str, Any]) -> dict[str, Any]:
        """Convert weights to modules."""
        policy = self._starts[0]["policy"]
        fresh = MlpPolicy(policy.window, policy.hidden, mean=float(policy.mean), std=float(policy.std))
        modules = self.networks(self.config, fresh, [0] * len(self.stacks))
        for name, row in rows.items():
            into_module(row, modules[name])
        return modules

    def state(self) -> dict[str, Any]:
        """Return weights, targets, Adam's moments and the running losses."""
        return {
            "weights": {name: stack.weights.cpu().clone() for name, stack in self.stacks.items()},
            "targets": {name: stack.weights.cpu().clone() for name, stack in self.target_stacks.items()},
            "adams": {name: adam.state() for name, adam in self.adams.items()},
            "counts": [self._updates, self._since_measure],
            "sums": {name: total.cpu().clone() for name, total in self._sums.items()},
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Put a `state` back."""
        for name, weights in state["weights"].items():
            self.stacks[name].weights.copy_(weights)
        for name, weights in state["targets"].items():
            self.target_stacks[name].weights.copy_(weights)
        for name, adam in state["adams"].items():
            self.adams[name].load_state(adam)
        self._updates, self._since_measure = state["counts"]
        self._sums = {name: total.to(self.device) for name, total in state["sums"].items()}

    def member_setting(self, name: str) -> Any:
        """Return a hyper-parameter of `per_member`, tensor [K, 1, 1]."""
        return self._settings[name]

    def _per_member(self, name: str) -> Any:
        values = [getattr(config, name) for config in self.configs]
        return torch.tensor(values, dtype=torch.float32, device=self.device).view(-1, 1, 1)

    def _count_update(self) -> None:
        self._updates += 1
        self._since_measure += 1

    def _note(self, name: str, per_row: Any) -> None:
        """Add the mean over rows [K, B, 1] to a running loss."""
        mean = per_row.mean(dim=(1, 2))
        total = self._sums.get(name)
        self._sums[name] = mean.double() if total is None else total.add_(mean)

    def _in_reward_units(self, name: str, value: float) -> float:
        return value / self.scale.factor**2 if name == "critic_loss" else value

    def _probe_values(self, scores: Any, actions: Any) -> list[float] | None:
        critic = self.stacks.get("critic")
        return None if critic is None else critic.forward(scores, actions).mean(dim=(1, 2)).tolist()

    def _copy(self, name: str, starts: Sequence[Networks], shared: Stack | None) -> Stack:
        return Stack([start[name] for start in starts], self.config.batch, self.device, shares=shared)

    def _adam(self, name: str) -> StackedAdam:
        rate = "actor_lr" if name == "policy" else "critic_lr"
        decay = 0.0 if name == "policy" else float(getattr(self.config, "critic_weight_decay", 0.0))
        return StackedAdam(self.stacks[name], [getattr(config, rate) for config in self.configs], decay)


CC = TypeVar("CC", bound=CriticConfig)


class CriticLearner(StackedLearner[CC], Generic[CC]):
    """A learner with critics, warm-up and targets."""

    def _descend_on_target(self, name: str, batch: TransitionBatch, targets: Any) -> None:
        """Take one step of a critic's least squares Q(s, a) towards `targets` [K, B, 1]."""
        critic = self.stacks[name]
        error = critic.forward(batch.critic_states, batch.actions).sub_(targets)
        if name == "critic":
            self._note("critic_loss", error.square())
        critic.backward(error.mul_(2.0 / error.shape[1]))
        self.adams[name].step()

    def _follow(self) -> None:
        """Move the targets: theta' <- (1 - tau) theta' + tau theta."""
        for name, target in self.target_stacks.items():
            target.weights.lerp_(self.stacks[name].weights, self.config.tau)

    @property
    def _warm(self) -> bool:
        return self._updates >= self.config.critic_warmup


def fresh_critic(config: TrainConfig, policy: MlpPolicy, seed: int, *, layer_norm: bool = False) -> Critic:
    """Make a critic of the configuration's sizes."""
    return Critic(critic_inputs(config, policy), config.hidden, layer_norm=layer_norm, seed=seed)


def remembers(config: TrainConfig) -> bool:
    """Decide whether the critics of a training see past amplitudes."""
    return isinstance(config, CriticConfig) and config.critic_memory


def critic_inputs(config: TrainConfig, policy: MlpPolicy) -> int:
    """Count the numbers that a critic sees of a state."""
    return policy.window + (len(SPANS_S) if remembers(config) else 0)
