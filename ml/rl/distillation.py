"""Policy distillation: a student small enough for the tablet, and later the implant. Source: Gao et al. 2023, section 4.2, eq:distillation.

The student minimises the mean squared error to the teacher's amplitude fractions. The states are those of the replay buffer, and synthetic
ones: buffer states with Gaussian noise on every element.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ml.policies.policy import Policy
from ml.progress import Report, silent
from ml.rl.kernels.networks import STUDENT_HIDDEN, MlpPolicy
from ml.rl.loop import TrainingDiverged, single_thread
from ml.trajectories import ReplayBuffer

Agreement = Callable[[Policy, Policy], dict[str, float]]
"""Compares a student with its teacher, in that order, beyond their actions: by estimated returns, for example."""

_BLOCK = 64  # batches whose noisy states the teacher labels in one call
_TRAIN_STREAM, _TEST_STREAM = 2, 3
_TEST_COPIES = 4  # noisy copies of each buffer state on which the student is judged


@dataclass(frozen=True, kw_only=True)
class DistilConfig:
    """Hyper-parameters of one distillation.

    Attributes:
        hidden: units of the student's hidden layers (the paper's 20 and 10).
        sigma: standard deviation of the noise of synthetic states, as a share of the standard deviation of beta; 0 makes none.
        batch: states per update; half of them synthetic when sigma is above 0.
        updates: gradient steps.
        lr: Adam's learning rate at the start; it falls to 0 along a half cosine.
        seed: of the initial weights, the batches and the noise.
        record_every: updates between two points of the learning curve.

    Raises:
        ValueError: a value outside its range; the message names it.
    """

    hidden: tuple[int, ...] = STUDENT_HIDDEN
    sigma: float = 0.3
    batch: int = 256
    updates: int = 5000
    lr: float = 5e-3
    seed: int = 0
    record_every: int = 100

    def __post_init__(self) -> None:
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden must name one layer or more, each of 1 unit or more, not {self.hidden}")
        if not (math.isfinite(self.sigma) and self.sigma >= 0):
            raise ValueError(f"sigma must be 0 or more, not {self.sigma}")
        if not (math.isfinite(self.lr) and 0 < self.lr <= 1):
            raise ValueError(f"lr must lie in (0, 1], not {self.lr}")
        if self.batch < 2 or self.updates < 1 or self.record_every < 1 or self.seed < 0:
            raise ValueError("batch must be 2 or more, updates and record_every 1 or more, seed 0 or more")

    def to_json(self) -> dict[str, Any]:
        """Return all hyper-parameters, by name."""
        return asdict(self) | {"hidden": list(self.hidden)}

    @staticmethod
    def from_json(values: dict[str, Any]) -> DistilConfig:
        """Read what `to_json` wrote; missing names take their default. Raises ValueError for an unknown name."""
        unknown = sorted(set(values) - set(DistilConfig.__dataclass_fields__))
        if unknown:
            known = ", ".join(DistilConfig.__dataclass_fields__)
            raise ValueError(f"distillation has no hyper-parameter {', '.join(unknown)}; it has {known}")
        config = DistilConfig(**values)
        return replace(config, hidden=tuple(config.hidden))


@dataclass(frozen=True)
class ActionError:
    """Distance of the student's amplitude fraction from the teacher's over a set of states: mean, 99th percentile and worst."""

    mean: float
    p99: float
    worst: float

    @staticmethod
    def between(student: NDArray[np.float64], teacher: NDArray[np.float64]) -> ActionError:
        """Compute the errors of actions, both [N]."""
        error = np.abs(student - teacher)
        return ActionError(float(error.mean()), float(np.quantile(error, 0.99)), float(error.max()))


@dataclass(frozen=True)
class DistilledPolicy:
    """A student and how well it follows its teacher.

    Attributes:
        policy: the student.
        on_buffer: action error over the buffer's states.
        on_noise: action error over noisy copies of them that were not trained on; None when sigma is 0.
        parameters: weights and biases of the student.
        macs: multiply-accumulate operations per decision.
        curve: `update` and `loss` (mean squared action error since the last point), arrays of one length.
        config: the hyper-parameters.
        agreement: what the caller's comparison with the teacher says, by name.
    """

    policy: MlpPolicy
    on_buffer: ActionError
    on_noise: ActionError | None
    parameters: int
    macs: int
    curve: dict[str, NDArray[np.float64]]
    config: DistilConfig
    agreement: dict[str, float] = field(default_factory=dict)

    @property
    def weight_bytes(self) -> int:
        """Bytes of the weights as float32; a quarter of it as int8."""
        return 4 * self.parameters

    def report(self) -> dict[str, Any]:
        """Return errors and size, to be stored with the policy."""
        return {
            "on_buffer": asdict(self.on_buffer),
            "on_noise": asdict(self.on_noise) if self.on_noise else None,
            "parameters": self.parameters,
            "weight_bytes": self.weight_bytes,
            "macs": self.macs,
            "agreement": dict(self.agreement),
        }


def distil(
    teacher: Policy, buffer: ReplayBuffer, config: DistilConfig, report: Report = silent, agreement: Agreement | None = None
) -> DistilledPolicy:
    """Train a student to act as the teacher does (eq:distillation).

    Args:
        teacher: any policy of the participant's beta windows.
        buffer: sessions whose states the student learns on, whatever controller they had.
        config: hyper-parameters.
        report: called with the progress.
        agreement: compares student and teacher once, at the end.

    Returns:
        The student, the same bit for bit for the same teacher, buffer and configuration on one machine.

    Raises:
        ValueError: no usable step in the buffer.
        TrainingDiverged: the loss is not finite.
    """
    states = buffer.transitions().states
    mean, std = buffer.beta_scale()
    student = MlpPolicy(buffer.settings.window, config.hidden, mean=mean, std=std, seed=config.seed)
    with single_thread():
        curve = _fit(student, teacher, states, config.sigma * std, config, report)
        on_buffer = ActionError.between(student.act(states), teacher.act(states))
        on_noise = None
        if config.sigma > 0:
            rng = np.random.default_rng([config.seed, _TEST_STREAM])
            noisy = np.repeat(states, _TEST_COPIES, axis=0)
            noisy = noisy + rng.normal(0.0, config.sigma * std, noisy.shape)
            on_noise = ActionError.between(student.act(noisy), teacher.act(noisy))
    agreed = {} if agreement is None else agreement(student, teacher)
    return DistilledPolicy(student, on_buffer, on_noise, student.parameter_count, student.macs, curve, config, agreed)


def _fit(
    student: MlpPolicy, teacher: Policy, states: NDArray[np.float64], noise_sd: float, config: DistilConfig, report: Report
) -> dict[str, NDArray[np.float64]]:
    adam = torch.optim.Adam(student.parameters(), lr=config.lr, fused=True)
    points: list[tuple[float, float]] = []
    loss_sum, since = torch.zeros((), dtype=torch.float64), 0
    windows: Any = None
    answers: Any = None
    for update in range(config.updates):
        block, row = divmod(update, _BLOCK)
        if row == 0:
            windows, answers = _labelled_block(student, teacher, states, noise_sd, config, block)
        adam.param_groups[0]["lr"] = config.lr * 0.5 * (1 + math.cos(math.pi * update / config.updates))
        loss = torch.nn.functional.mse_loss(student.act_on_scores(windows[row]), answers[row])
        adam.zero_grad()
        loss.backward()
        adam.step()
        loss_sum += loss.detach()
        since += 1
        finished = update + 1
        if finished % config.record_every == 0 or finished == config.updates:
            mean_loss = float(loss_sum) / since
            if not math.isfinite(mean_loss):
                raise TrainingDiverged(f"the student's loss is {mean_loss} after update {finished}: lower the learning rate")
            points.append((float(finished), mean_loss))
            report(finished / config.updates, f"update {finished} of {config.updates}", loss=mean_loss)
            loss_sum.zero_()
            since = 0
    return {"update": np.array([p[0] for p in points]), "loss": np.array([p[1] for p in points])}


def _labelled_block(
    student: MlpPolicy, teacher: Policy, states: NDArray[np.float64], noise_sd: float, config: DistilConfig, block: int
) -> tuple[Any, Any]:
    """Make z-scored windows [64, B, W] and the teacher's fractions [64, B, 1]; the second half of each batch has fresh noise."""
    rng = np.random.default_rng([config.seed, _TRAIN_STREAM, block])
    windows = states[rng.integers(0, len(states), (_BLOCK, config.batch))]
    if noise_sd > 0:
        synthetic = windows[:, config.batch // 2 :]
        synthetic += rng.normal(0.0, noise_sd, synthetic.shape)  # a view: fancy indexing above made `windows` a copy of the buffer
    answers = teacher.act(windows.reshape(-1, states.shape[1])).reshape(_BLOCK, config.batch, 1)
    return student.normalise(torch.tensor(windows, dtype=torch.float32)), torch.tensor(answers, dtype=torch.float32)
