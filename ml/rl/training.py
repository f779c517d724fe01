"""Training with any of the algorithms: one policy, or K side by side; the configuration names the algorithm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.progress import Report, silent
from ml.rl.algorithms._learner import StackedLearner, remembers
from ml.rl.algorithms.registry import algorithm
from ml.rl.configs import TrainConfig
from ml.rl.end_reward import fit_end_reward
from ml.rl.held_out import HeldOutSessions
from ml.rl.kernels.batches import RewardScale, packed
from ml.rl.kernels.networks import MlpPolicy
from ml.rl.loop import (
    Curve,
    MemberRecord,
    Schedule,
    as_curve,
    fingerprint_of,
    run,
    single_thread,
    tensors_from_bytes,
    tensors_to_bytes,
)
from ml.rl.memory import memory_of
from ml.trajectories import ReplayBuffer, Transitions

_UNSHARED = {"checkpoint_every"}
"""Hyper-parameters that change no result and are omitted from a checkpoint's name."""


@dataclass(frozen=True)
class TrainedPolicy:
    """Result of a training, with its critics, so that fine-tuning can continue from it.

    Attributes:
        policy: the actor.
        networks: the algorithm's other networks by name (`critic`, `critic_2`, `value`); on z-scored windows and scaled rewards.
        reward_scale: how the critics' rewards were scaled.
        curve: learning curves by name, arrays of one length, with `update`. `critic_loss`: mean squared temporal-difference error since the
            last point, in squared reward units. `mean_q`: mean Q(s, pi(s)) over a probe of the buffer, in reward units; an unbounded climb
            is over-estimation. `action_distance`: mean |pi(s) - a| to the logged actions of the probe. `saturated`: share of the probe's
            states answered within 0.01 of 0 or 1. At 1 the tanh has no slope left, and the policy is cDBS or no-DBS by another name. The
            algorithm's own losses follow.
        config: the hyper-parameters, with the seed.
        held_out: curves on the held-out sessions, empty without them. `update`; `score`, the caller's estimate; `start_q`, mean Q(s_0,
            pi(s_0)). `over_logged`: `start_q` less the return logged from s_0 under whatever controller was in force. `over_estimate`:
            `start_q` less `score`, where the score is a step return.
        best_update: the update whose state this is, chosen by `score`; None means the last.
    """

    policy: MlpPolicy
    networks: dict[str, Any]
    reward_scale: RewardScale
    curve: Curve
    config: TrainConfig
    held_out: Curve = field(default_factory=dict)
    best_update: int | None = None

    @property
    def seed(self) -> int:
        """Seed of the initial weights and of the batches."""
        return self.config.seed

    @property
    def algorithm(self) -> str:
        """Key in `ml.rl.algorithms.registry.ALGORITHMS`."""
        return self.config.algorithm

    @property
    def critic(self) -> Any:
        """Q(s, a). Raises KeyError for an algorithm without a critic."""
        return self.networks["critic"]

    def to_bytes(self) -> bytes:
        """Write everything as bytes, for the file store."""
        return tensors_to_bytes(
            {
                "algorithm": self.algorithm,
                "config": self.config.to_json(),
                "reward_scale": list(self.reward_scale),
                "shape": [self.policy.window, list(self.policy.hidden)],
                "policy": self.policy.state_dict(),
                "networks": {name: network.state_dict() for name, network in self.networks.items()},
                "curve": {name: values.tolist() for name, values in self.curve.items()},
                "held_out": {name: values.tolist() for name, values in self.held_out.items()},
                "best_update": self.best_update,
            }
        )

    @staticmethod
    def from_bytes(content: bytes) -> TrainedPolicy:
        """Read what `to_bytes` wrote. Raises ValueError when the bytes are no such training."""
        saved = tensors_from_bytes(content)
        try:
            learner = algorithm(saved["algorithm"]).learner
            config = learner.config_type.from_json(saved["config"])
            window, hidden = saved["shape"]
            policy = MlpPolicy(window, hidden)
            policy.load_state_dict(saved["policy"])
            stored = saved["networks"]
            networks = learner.networks(config, policy, [0] * (len(stored) + 1))
            for name, weights in stored.items():
                networks[name].load_state_dict(weights)
            del networks["policy"]
            curve, held_out = ({n: np.array(v) for n, v in saved.get(part, {}).items()} for part in ("curve", "held_out"))
            scale = RewardScale(*saved["reward_scale"])
            return TrainedPolicy(policy, networks, scale, curve, config, held_out, saved.get("best_update"))
        except (KeyError, TypeError, RuntimeError) as error:
            raise ValueError(f"these bytes are no stored training: {error}") from error


Start = TrainedPolicy | MlpPolicy | None


def train(
    buffer: ReplayBuffer,
    config: TrainConfig,
    report: Report = silent,
    checkpoint: Path | None = None,
    initial: Start = None,
    held_out: HeldOutSessions | None = None,
) -> TrainedPolicy:
    """Train one policy; arguments and errors as in `train_many`."""
    return train_many(buffer, [config], report, checkpoint, initial, held_out)[0]


def train_many(
    buffer: ReplayBuffer,
    configs: Sequence[TrainConfig],
    report: Report = silent,
    checkpoint: Path | None = None,
    initial: Start = None,
    held_out: HeldOutSessions | None = None,
) -> list[TrainedPolicy]:
    """Train K policies side by side on a participant's replay buffer, whatever controllers its sessions had; gamma comes from its settings.

    Args:
        buffer: the sessions, without the held-out ones.
        configs: hyper-parameters of each policy, all of one algorithm, which they name; only those in `TrainConfig.per_member` may differ.
        report: called with the progress and the learning curves' points (with `_1`, `_2`, ... behind the names where K is above 1).
        checkpoint: file that holds the state of the training; where it exists, the training goes on from it. Not removed at the end.
        initial: start of a fine-tuning, which stays unchanged: a training (all its networks and scales) or a policy alone. The critics of a
            policy alone start afresh (set `critic_warmup`). The beta scale stays the initial policy's, or it would be another function.
        held_out: sessions that watch the training, and the score by which its best state is chosen.

    Returns:
        The trained policies in the order of `configs`; the same bit for bit on one machine for the same arguments.

    Raises:
        ValueError: no usable step; configurations that cannot be trained together. An initial policy of another window, other hidden layers
            or another algorithm; CUDA requested where there is none.
        TrainingDiverged: a loss or value is not finite.
        CheckpointError: the checkpoint belongs to another run, or is damaged.
    """
    share = fit_end_reward(buffer) if configs and configs[0].aim == "return" else None
    data = buffer.transitions()
    if share is not None:
        # usable steps have a known amplitude and beta, so that every one has a share
        shares = np.concatenate([share.per_step(s)[s.usable()] for s in buffer.sessions])
        data = replace(data, rewards=data.rewards + shares)
        held_out = replace(held_out, end_reward=share) if held_out else None
    memory = memory_of(buffer, data) if configs and remembers(configs[0]) else None
    return train_on(data, buffer.settings.gamma, buffer.beta_scale(), configs, report, checkpoint, initial, held_out, memory)


def train_on(
    transitions: Transitions,
    gamma: float,
    beta_scale: tuple[float, float],
    configs: Sequence[TrainConfig],
    report: Report = silent,
    checkpoint: Path | None = None,
    initial: Start = None,
    held_out: HeldOutSessions | None = None,
    memory: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> list[TrainedPolicy]:
    """Run `train_many` on transitions of any source, with gamma, the mean and standard deviation of beta, and what critics remember."""
    _require_together(configs)
    if remembers(configs[0]) and memory is None:
        raise ValueError("critics with a memory of past amplitudes need it with the transitions")
    config, device = configs[0], configs[0].resolved_device()
    learner_type = algorithm(config.algorithm).learner
    scale = RewardScale.of(transitions.rewards, gamma)
    if isinstance(initial, TrainedPolicy):
        # Stored critics go on in their own reward scale; any affine scale is right for any buffer.
        scale = initial.reward_scale._replace(gamma=gamma)
    with single_thread():
        starts = [_start(learner_type, transitions.states.shape[1], beta_scale, own, initial) for own in configs]
        learner = learner_type(starts, configs, scale, device)
        data = packed(transitions, starts[0]["policy"].normalise, scale, memory if remembers(config) else None)
        named = [{n: v for n, v in own.to_json().items() if n not in _UNSHARED} for own in configs]
        owner = {"algorithm": config.algorithm, "configs": named, "gamma": gamma, "device": device}
        fingerprint = fingerprint_of(data, owner | {"held_out": held_out.name() if held_out else None}, learner.state())
        schedule = Schedule(
            updates=config.updates,
            batch=config.batch,
            seeds=tuple(own.seed for own in configs),
            record_every=config.record_every,
            checkpoint_every=config.checkpoint_every,
            device=device,
        )
        records = run(learner, data.to(device), schedule, fingerprint=fingerprint, report=report, checkpoint=checkpoint, held_out=held_out)
        return [_result_of(learner, k, record) for k, record in enumerate(records)]


def _result_of(learner: StackedLearner[Any], member: int, record: MemberRecord) -> TrainedPolicy:
    networks = learner.modules(record.best_rows or learner.rows(member))
    policy = networks.pop("policy")
    curve, held_out = as_curve(record.points), as_curve(record.held_out)
    return TrainedPolicy(policy, networks, learner.scale, curve, learner.configs[member], held_out, record.best_update)


def _require_together(configs: Sequence[TrainConfig]) -> None:
    if not configs:
        raise ValueError("a training needs one configuration or more")
    first = configs[0]
    for config in configs:
        if type(config) is not type(first):
            raise ValueError(f"policies trained side by side have one algorithm, not {first.algorithm} and {config.algorithm}")
        own, others = config.to_json(), first.to_json()
        apart = [name for name in own if own[name] != others[name] and name not in first.per_member]
        if apart:
            raise ValueError(
                f"policies trained side by side may differ in {', '.join(first.per_member)}, not in {', '.join(apart)}; train them apart"
            )


def _start(
    learner_type: type[StackedLearner[Any]], window: int, beta_scale: tuple[float, float], config: TrainConfig, initial: Start
) -> dict[str, Any]:
    """Make the networks of one member."""
    actor_seed, *seeds = (int(s.generate_state(1)[0]) for s in np.random.SeedSequence(config.seed).spawn(4))
    policy = initial.policy if isinstance(initial, TrainedPolicy) else initial
    if policy is None:
        policy = MlpPolicy(window, config.hidden, mean=beta_scale[0], std=beta_scale[1], seed=actor_seed)
    if policy.window != window or policy.hidden != config.hidden:
        raise ValueError(
            f"the initial policy has a window of {policy.window} and hidden layers {policy.hidden}; "
            f"the buffer has a window of {window} and the configuration hidden layers {config.hidden}"
        )
    if not isinstance(initial, TrainedPolicy):
        return learner_type.networks(config, policy, seeds)
    if initial.algorithm != config.algorithm:
        raise ValueError(
            f"the initial training is of {initial.algorithm}, whose critics {config.algorithm} cannot go on with; "
            "start from its policy alone, with a critic_warmup"
        )
    if remembers(initial.config) != remembers(config):
        raise ValueError(
            "the initial training's critics "
            + (
                "remember past amplitudes; set critic_memory"
                if remembers(initial.config)
                else "know no past amplitudes; unset critic_memory"
            )
            + ", or start from its policy alone, with a critic_warmup"
        )
    return {"policy": policy, **initial.networks}
