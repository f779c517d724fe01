"""The training loop that every offline learner shares: packed data, reproducible batches, learning curves, checkpoints.

A learner knows one gradient step; the loop knows when to measure, report and save. Batches are drawn from a counter, not from a running
generator: block b of a run with seed s always holds the same rows. The state of the random numbers is therefore the update number alone,
and a run resumed from a checkpoint goes on bit for bit as if it had not been interrupted (same machine, one thread).
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ml.progress import Report
from ml.trajectories import Transitions

_BLOCK = 256  # batches drawn at once: one call of the generator per block instead of one per update
_BATCH_STREAM = 1
_CHECKPOINT_FORMAT = 1
_PROBE_STATES = 2048


class TrainingDiverged(ArithmeticError):
    """A loss or value is no longer a finite number."""


class CheckpointError(ValueError):
    """The checkpoint file cannot be read, or belongs to another run."""


class Batch(NamedTuple):
    """Rows of a buffer as float32 tensors: z-scored states [B, W], actions [B, 1], scaled rewards [B, 1], z-scored next states [B, W]."""

    states: Any
    actions: Any
    rewards: Any
    next_states: Any


class PackedTransitions:
    """A buffer in one tensor [N, 2W + 2], so that a batch is one gather.

    Args:
        states, next_states: z-scored windows, float32 tensors [N, W].
        actions, rewards: float32 tensors [N].
    """

    def __init__(self, states: Any, actions: Any, rewards: Any, next_states: Any) -> None:
        self._window = states.shape[1]
        self._rows = torch.cat([states, actions[:, None], rewards[:, None], next_states], dim=1).contiguous()

    def __len__(self) -> int:
        return int(self._rows.shape[0])

    def take(self, index: Any) -> Batch:
        """The rows of an int64 tensor [B]; a copy, so that nothing a learner does can reach the buffer."""
        rows, w = self._rows.index_select(0, index), self._window
        return Batch(rows[:, :w], rows[:, w : w + 1], rows[:, w + 1 : w + 2], rows[:, w + 2 :])

    def probe(self) -> Batch:
        """Up to 2048 rows spread evenly over the buffer, for measurements."""
        return self.take(torch.from_numpy(np.unique(np.linspace(0, len(self) - 1, _PROBE_STATES).astype(np.int64))))

    def digest(self) -> str:
        """SHA-256 of the packed numbers."""
        return hashlib.sha256(self._rows.numpy().tobytes()).hexdigest()


class RewardScale(NamedTuple):
    """Rewards as the critic sees them: (r - shift) * factor.

    A session's end is a time limit, not a terminal state, so every target bootstraps; an affine change of the rewards is then an affine
    change of every return, Q' = factor (Q - shift / (1 - gamma)), and no policy gains or loses by it. The shift is the buffer's mean
    reward: without it the critic would spend its first ten thousands of updates sinking from 0 to r / (1 - gamma). The factor is
    sqrt(1 - gamma^2) / sd(r), which gives discounted sums of independent rewards a standard deviation of 1, the scale that the networks'
    initial weights and Adam's steps suit.
    """

    shift: float
    factor: float
    gamma: float

    @staticmethod
    def of(rewards: NDArray[np.float64], gamma: float) -> RewardScale:
        """The scale of a buffer's rewards, shape [N]; factor 1 where all are equal."""
        deviation = float(rewards.std())
        return RewardScale(float(rewards.mean()), math.sqrt(1 - gamma**2) / deviation if deviation > 1e-12 else 1.0, gamma)

    def scaled(self, rewards: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rewards for the critic."""
        return (rewards - self.shift) * self.factor

    def value(self, scaled: float) -> float:
        """A critic's output in the unit of the rewards."""
        return scaled / self.factor + self.shift / (1 - self.gamma)


class Learner(Protocol):
    """One algorithm: its networks and one gradient step."""

    def update(self, batch: Batch) -> None:
        """One update of the networks; leaves the batch as it is."""

    def measure(self, probe: Batch) -> dict[str, float]:
        """Points of the learning curves: means since the last call, and values on the probe."""

    def state(self) -> dict[str, Any]:
        """Everything that the next update depends on (weights, targets, optimisers): tensors, numbers, lists, dictionaries."""

    def load_state(self, state: dict[str, Any]) -> None:
        """Put `state` back."""


def packed(transitions: Transitions, normalise: Any, scale: RewardScale) -> PackedTransitions:
    """Transitions for learners: windows z-scored by `normalise` (a policy's own), rewards scaled."""
    return PackedTransitions(
        normalise(torch.tensor(transitions.states, dtype=torch.float32)),
        torch.tensor(transitions.actions, dtype=torch.float32),
        torch.tensor(scale.scaled(transitions.rewards), dtype=torch.float32),
        normalise(torch.tensor(transitions.next_states, dtype=torch.float32)),
    )


def batch_indices(seed: int, block: int, size: int, batch: int) -> Any:
    """Rows of the 256 batches of a block, int64 tensor [256, batch], drawn uniformly with replacement from a buffer of `size` rows."""
    return torch.from_numpy(np.random.default_rng([seed, _BATCH_STREAM, block]).integers(0, size, (_BLOCK, batch)))


def run(
    learner: Learner,
    data: PackedTransitions,
    *,
    updates: int,
    batch: int,
    seed: int,
    record_every: int,
    checkpoint_every: int,
    fingerprint: str,
    report: Report,
    checkpoint: Path | None,
) -> dict[str, NDArray[np.float64]]:
    """Train for `updates` updates, from the checkpoint where there is one.

    Returns:
        Learning curves by name, all of one length; `update` holds the update numbers.

    Raises:
        TrainingDiverged: a measured number is not finite.
        CheckpointError: the checkpoint is of another run, or damaged.
    """
    probe = data.probe()
    done = 0
    points: list[dict[str, float]] = []
    if checkpoint is not None and checkpoint.exists():
        done, points = _resume(learner, checkpoint, fingerprint)
    rows: Any = None
    for update in range(done, updates):
        block, row = divmod(update, _BLOCK)
        if row == 0 or rows is None:
            rows = batch_indices(seed, block, len(data), batch)
        learner.update(data.take(rows[row]))
        finished = update + 1
        if finished % record_every == 0 or finished == updates:
            numbers = learner.measure(probe)
            _require_finite(numbers, finished)
            points.append({"update": float(finished)} | numbers)
            report(finished / updates, f"update {finished} of {updates}", **numbers)
        if checkpoint is not None and (finished % checkpoint_every == 0 or finished == updates):
            _save(checkpoint, {"fingerprint": fingerprint, "update": finished, "points": points, "learner": learner.state()})
    return {name: np.array([point[name] for point in points]) for name in points[0]} if points else {}


def fingerprint_of(data: PackedTransitions, config: dict[str, Any], start: dict[str, Any]) -> str:
    """A name for a run: data, configuration and the weights it starts from. `checkpoint_every` changes no result and is left out."""
    digest = hashlib.sha256(json.dumps({k: v for k, v in config.items() if k != "checkpoint_every"}, sort_keys=True).encode())
    digest.update(data.digest().encode())
    for tensor in _tensors(start):
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """One torch thread inside the block: sums then have one order, and two trainings on two cores do not fight."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def tensors_to_bytes(state: dict[str, Any]) -> bytes:
    """A nest of dictionaries, lists, numbers and tensors as bytes."""
    sink = io.BytesIO()
    torch.save(state, sink)
    return sink.getvalue()


def tensors_from_bytes(content: bytes) -> dict[str, Any]:
    """The inverse of `tensors_to_bytes`; runs no code from the bytes. Raises ValueError when they are something else."""
    try:
        state = torch.load(io.BytesIO(content), weights_only=True)
    except Exception as error:  # torch raises pickle, zip, runtime and EOF errors for damaged files
        raise ValueError(f"these bytes hold no stored weights: {error}") from error
    if not isinstance(state, dict):
        raise ValueError("these bytes hold no stored weights: they are not a dictionary of tensors")
    return state


def _resume(learner: Learner, checkpoint: Path, fingerprint: str) -> tuple[int, list[dict[str, float]]]:
    try:
        saved = tensors_from_bytes(checkpoint.read_bytes())
        format_, owner = saved["format"], saved["fingerprint"]
    except (ValueError, KeyError) as error:
        raise CheckpointError(f"the checkpoint {checkpoint.name} cannot be read; delete it to train from the start ({error})") from error
    if format_ != _CHECKPOINT_FORMAT or owner != fingerprint:
        raise CheckpointError(
            f"the checkpoint {checkpoint.name} belongs to a run with other data, another configuration or another start; "
            "delete it to train from the start, or name another file"
        )
    learner.load_state(saved["learner"])
    return int(saved["update"]), list(saved["points"])


def _save(checkpoint: Path, content: dict[str, Any]) -> None:
    """Replace the checkpoint in one step: a kill at any moment leaves the old one or the new one, whole."""
    part = checkpoint.with_name(checkpoint.name + ".part")
    with part.open("wb") as sink:
        sink.write(tensors_to_bytes({"format": _CHECKPOINT_FORMAT} | content))
        sink.flush()
        os.fsync(sink.fileno())
    part.replace(checkpoint)


def _require_finite(numbers: dict[str, float], update: int) -> None:
    for name, value in numbers.items():
        if not math.isfinite(value):
            raise TrainingDiverged(f"{name} is {value} after update {update}: the training diverged; lower the learning rates")


def _tensors(state: Any) -> Iterator[Any]:
    if isinstance(state, torch.Tensor):
        yield state.detach().cpu().contiguous()
    elif isinstance(state, dict):
        for key in sorted(state, key=str):
            yield from _tensors(state[key])
    elif isinstance(state, list | tuple):
        for item in state:
            yield from _tensors(item)
