"""Deep deterministic policy gradient (DDPG), offline. Source: Gao et al. 2023, section 2.2 and appendix C.1, after Lillicrap et al. 2016.

One update, in this order, on a batch of the replay buffer:

1. critic: least squares of Q(s, a) towards y = r + gamma Q'(s', pi'(s')), with target networks Q', pi';
2. actor: one step up the mean of Q(s, pi(s)) (eq:ac_objective);
3. targets: theta' <- (1 - tau) theta' + tau theta.

There are no terminal flags. A session ends because the clinic's time is over, not because the participant reached a final state; cutting
the bootstrap there would teach the critic that stopping the clock stops the pathology. There is no exploration noise (the data are
logged) and no term but the above: nothing holds the actor near the logged actions, so read `action_distance` and `mean_q` of the
learning curves.
"""

from __future__ import annotations

import copy
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ml.progress import Report, silent
from ml.rl.networks import TEACHER_HIDDEN, Critic, MlpPolicy
from ml.rl.training import (
    Batch,
    RewardScale,
    fingerprint_of,
    packed,
    run,
    single_thread,
    tensors_from_bytes,
    tensors_to_bytes,
)
from ml.trajectories import ReplayBuffer, Transitions

SATURATION_MARGIN = 0.01
"""An amplitude fraction this near to 0 or 1 counts as saturated."""


@dataclass(frozen=True, kw_only=True)
class DdpgConfig:
    """Hyper-parameters of one DDPG training; with the data and the start they settle the result.

    Attributes:
        actor_lr: Adam's learning rate of the policy. The paper: 1e-5 to 1e-3 from scratch, 1e-7 to 1e-5 for fine-tuning.
        critic_lr: Adam's learning rate of the critic (Lillicrap's 1e-3).
        tau: share of the online weights that the targets take per update. Lillicrap's 1e-3 needs some 1e5 updates at gamma 0.99; ours is
            5e-3.
        batch: transitions per update (Lillicrap's 64).
        updates: gradient steps.
        hidden: units of the hidden layers of actor and critic (the paper's 400 and 300); two layers or more.
        critic_weight_decay: L2 penalty on the critic's weights inside Adam's gradient. Lillicrap has 1e-2; ours is 0: on simulated sessions
            that penalty left four times the temporal-difference error.
        critic_warmup: updates during which only the critic learns: a policy fine-tuned without its critic is evaluated before it is
            changed.
        seed: of the initial weights and of the batches.
        record_every: updates between two points of the learning curves.
        checkpoint_every: updates between two checkpoints.

    Raises:
        ValueError: a value outside its range; the message names it.
    """

    actor_lr: float = 1e-4
    critic_lr: float = 1e-3
    tau: float = 5e-3
    batch: int = 64
    updates: int = 10_000
    hidden: tuple[int, ...] = TEACHER_HIDDEN
    critic_weight_decay: float = 0.0
    critic_warmup: int = 0
    seed: int = 0
    record_every: int = 100
    checkpoint_every: int = 1000

    def __post_init__(self) -> None:
        for name in ("actor_lr", "critic_lr", "tau"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0 < value <= 1):
                raise ValueError(f"{name} must lie in (0, 1], not {value}")
        for name in ("batch", "updates", "record_every", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be 1 or more, not {getattr(self, name)}")
        if not 0 <= self.critic_warmup <= self.updates:
            raise ValueError(f"critic_warmup must lie between 0 and updates ({self.updates}), not {self.critic_warmup}")
        if not (math.isfinite(self.critic_weight_decay) and self.critic_weight_decay >= 0):
            raise ValueError(f"critic_weight_decay must be 0 or more, not {self.critic_weight_decay}")
        if len(self.hidden) < 2 or min(self.hidden) < 1:
            raise ValueError(f"hidden must name two layers or more, each of 1 unit or more, not {self.hidden}")
        if self.seed < 0:
            raise ValueError(f"seed must be 0 or more, not {self.seed}")

    def to_json(self) -> dict[str, Any]:
        """All hyper-parameters, by name."""
        return asdict(self) | {"hidden": list(self.hidden)}

    @staticmethod
    def from_json(values: dict[str, Any]) -> DdpgConfig:
        """The inverse of `to_json`; missing names take their default. Raises ValueError for a name that is none."""
        unknown = sorted(set(values) - set(DdpgConfig.__dataclass_fields__))
        if unknown:
            raise ValueError(f"DDPG has no hyper-parameter {', '.join(unknown)}; it has {', '.join(DdpgConfig.__dataclass_fields__)}")
        config = DdpgConfig(**values)
        return replace(config, hidden=tuple(config.hidden))


@dataclass(frozen=True)
class TrainedPolicy:
    """What a training leaves behind; with its critic, so that fine-tuning can go on from it.

    Attributes:
        policy: the actor.
        critic: Q(s, a) of the last update, on z-scored windows and scaled rewards.
        reward_scale: how the critic's rewards were scaled.
        curve: learning curves by name, arrays of one length: `update`; `critic_loss` (mean squared temporal-difference error since the last
            point, in squared reward units); `mean_q` (mean Q(s, pi(s)) over a probe of the buffer, in reward units: an unbounded climb is
            over-estimation); `action_distance` (mean |pi(s) - a| to the logged actions of the probe); `saturated` (share of the probe's
            states answered within 0.01 of 0 or 1: at 1 the tanh has no slope left, and the policy is cDBS or no-DBS by another name).
        config: the hyper-parameters, with the seed.
    """

    policy: MlpPolicy
    critic: Critic
    reward_scale: RewardScale
    curve: dict[str, NDArray[np.float64]]
    config: DdpgConfig

    @property
    def seed(self) -> int:
        """Seed of the initial weights and of the batches."""
        return self.config.seed

    def to_bytes(self) -> bytes:
        """Everything as bytes, for the file store."""
        return tensors_to_bytes(
            {
                "algorithm": "ddpg",
                "config": self.config.to_json(),
                "reward_scale": list(self.reward_scale),
                "shape": [self.policy.window, list(self.policy.hidden)],
                "policy": self.policy.state_dict(),
                "critic": self.critic.state_dict(),
                "curve": {name: values.tolist() for name, values in self.curve.items()},
            }
        )

    @staticmethod
    def from_bytes(content: bytes) -> TrainedPolicy:
        """The inverse of `to_bytes`. Raises ValueError when the bytes are no such training."""
        saved = tensors_from_bytes(content)
        try:
            window, hidden = saved["shape"]
            policy, critic = MlpPolicy(window, hidden), Critic(window, hidden)
            policy.load_state_dict(saved["policy"])
            critic.load_state_dict(saved["critic"])
            curve = {name: np.array(values) for name, values in saved["curve"].items()}
            return TrainedPolicy(policy, critic, RewardScale(*saved["reward_scale"]), curve, DdpgConfig.from_json(saved["config"]))
        except (KeyError, TypeError, RuntimeError) as error:
            raise ValueError(f"these bytes are no DDPG training: {error}") from error


class DdpgLearner:
    """Actor, critic, their targets and optimisers; the start is copied, never changed."""

    def __init__(self, policy: MlpPolicy, critic: Critic, config: DdpgConfig, scale: RewardScale) -> None:
        self.config, self.scale = config, scale
        self.policy, self.critic = copy.deepcopy(policy), copy.deepcopy(critic)
        self.target_policy, self.target_critic = copy.deepcopy(policy), copy.deepcopy(critic)
        self._actor_weights, self._critic_weights = list(self.policy.parameters()), list(self.critic.parameters())
        self._online = self._actor_weights + self._critic_weights
        self._targets = [*self.target_policy.parameters(), *self.target_critic.parameters()]
        self._actor_adam = torch.optim.Adam(self._actor_weights, lr=config.actor_lr, fused=True)
        self._critic_adam = torch.optim.Adam(self._critic_weights, lr=config.critic_lr, weight_decay=config.critic_weight_decay, fused=True)
        self._updates = self._since_measure = 0
        self._loss_sum = torch.zeros((), dtype=torch.float64)

    def update(self, batch: Batch) -> None:
        """One DDPG update, in the order of the module's text."""
        with torch.no_grad():
            next_values = self.target_critic(batch.next_states, self.target_policy.act_on_scores(batch.next_states))
            targets = torch.add(batch.rewards, next_values, alpha=self.scale.gamma)
        loss = torch.nn.functional.mse_loss(self.critic(batch.states, batch.actions), targets)
        _descend(self._critic_adam, self._critic_weights, loss)
        if self._updates >= self.config.critic_warmup:
            # Gradients for the actor's weights alone: the critic's would be thrown away.
            _descend(self._actor_adam, self._actor_weights, -self.critic(batch.states, self.policy.act_on_scores(batch.states)).mean())
        with torch.no_grad():
            torch._foreach_lerp_(self._targets, self._online, self.config.tau)
        self._loss_sum += loss.detach()
        self._updates += 1
        self._since_measure += 1

    def measure(self, probe: Batch) -> dict[str, float]:
        """The points of the learning curves, as `TrainedPolicy.curve` describes them."""
        with torch.no_grad():
            actions = self.policy.act_on_scores(probe.states)
            mean_q = float(self.critic(probe.states, actions).mean())
            distance = float((actions - probe.actions).abs().mean())
            saturated = float(((actions - 0.5).abs() > 0.5 - SATURATION_MARGIN).double().mean())
        loss = float(self._loss_sum) / max(self._since_measure, 1)
        self._loss_sum.zero_()
        self._since_measure = 0
        return {
            "critic_loss": loss / self.scale.factor**2,
            "mean_q": self.scale.value(mean_q),
            "action_distance": distance,
            "saturated": saturated,
        }

    def state(self) -> dict[str, Any]:
        """Weights, targets, Adam's moments and the running loss."""
        return {
            "networks": [net.state_dict() for net in self._networks()],
            "optimisers": [self._actor_adam.state_dict(), self._critic_adam.state_dict()],
            "counts": [self._updates, self._since_measure],
            "loss_sum": self._loss_sum.clone(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Put a `state` back."""
        for net, saved in zip(self._networks(), state["networks"], strict=True):
            net.load_state_dict(saved)
        for adam, saved in zip((self._actor_adam, self._critic_adam), state["optimisers"], strict=True):
            adam.load_state_dict(saved)
        self._updates, self._since_measure = state["counts"]
        self._loss_sum.copy_(state["loss_sum"])

    def _networks(self) -> tuple[Any, ...]:
        return self.policy, self.critic, self.target_policy, self.target_critic


def _descend(adam: Any, weights: list[Any], loss: Any) -> None:
    """One step of `adam` down the gradient of `loss` by its own weights; no other network's gradient is computed."""
    for weight, gradient in zip(weights, torch.autograd.grad(loss, weights), strict=True):
        weight.grad = gradient
    adam.step()


def train(
    buffer: ReplayBuffer,
    config: DdpgConfig,
    report: Report = silent,
    checkpoint: Path | None = None,
    initial: TrainedPolicy | MlpPolicy | None = None,
) -> TrainedPolicy:
    """Train a policy on a participant's replay buffer, whatever controllers its sessions had; gamma comes from the buffer's settings.

    Args:
        buffer: the sessions.
        config: hyper-parameters.
        report: told of the progress and of the learning curves' points.
        checkpoint: file that holds the state of the training; where it exists, the training goes on from it. Not removed at the end.
        initial: start of a fine-tuning, left as it is: a training (actor, critic and their scales) or a policy alone, whose critic then
            starts afresh (set `critic_warmup`). The beta scale stays the initial policy's, or it would be another function.

    Raises:
        ValueError: no usable step; an initial policy of another window or other hidden layers.
        TrainingDiverged: a loss or value is not finite.
        CheckpointError: the checkpoint belongs to another run, or is damaged.
    """
    return train_on(buffer.transitions(), buffer.settings.gamma, buffer.beta_scale(), config, report, checkpoint, initial)


def train_on(
    transitions: Transitions,
    gamma: float,
    beta_scale: tuple[float, float],
    config: DdpgConfig,
    report: Report = silent,
    checkpoint: Path | None = None,
    initial: TrainedPolicy | MlpPolicy | None = None,
) -> TrainedPolicy:
    """`train` on transitions of any source, with gamma and the mean and standard deviation of beta."""
    with single_thread():
        learner = _start(transitions, gamma, beta_scale, config, initial)
        data = packed(transitions, learner.policy.normalise, learner.scale)
        curve = run(
            learner,
            data,
            updates=config.updates,
            batch=config.batch,
            seed=config.seed,
            record_every=config.record_every,
            checkpoint_every=config.checkpoint_every,
            fingerprint=fingerprint_of(data, config.to_json() | {"gamma": gamma}, learner.state()),
            report=report,
            checkpoint=checkpoint,
        )
    return TrainedPolicy(learner.policy, learner.critic, learner.scale, curve, config)


def _start(
    transitions: Transitions, gamma: float, beta_scale: tuple[float, float], config: DdpgConfig, initial: TrainedPolicy | MlpPolicy | None
) -> DdpgLearner:
    window = transitions.states.shape[1]
    scale = RewardScale.of(transitions.rewards, gamma)
    actor_seed, critic_seed = (int(s.generate_state(1)[0]) for s in np.random.SeedSequence(config.seed).spawn(2))
    policy = initial.policy if isinstance(initial, TrainedPolicy) else initial
    if policy is None:
        policy = MlpPolicy(window, config.hidden, mean=beta_scale[0], std=beta_scale[1], seed=actor_seed)
    if policy.window != window or policy.hidden != config.hidden:
        raise ValueError(
            f"the initial policy has a window of {policy.window} and hidden layers {policy.hidden}; "
            f"the buffer has a window of {window} and the configuration hidden layers {config.hidden}"
        )
    critic = Critic(window, config.hidden, seed=critic_seed)
    if isinstance(initial, TrainedPolicy):
        # A stored critic goes on in its own reward scale; any affine scale is right for any buffer.
        critic, scale = initial.critic, initial.reward_scale._replace(gamma=gamma)
    return DdpgLearner(policy, critic, config, scale)
