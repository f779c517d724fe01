"""The training loop that every offline learner shares: reproducible batches, learning curves, checkpoints.

A learner knows one gradient step of K policies side by side; the loop knows when to measure, report and save. Batches are drawn from a
counter, not from a running generator: block b of a run with seed s always has the same rows. So the state of the random numbers is the
update number alone. A run resumed from a checkpoint continues bit for bit as if it had not been interrupted (same machine, one thread).
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ml.progress import Report
from ml.rl.held_out import HeldOutSessions
from ml.rl.kernels.batches import BLOCK, PackedTransitions, TransitionBatch, batch_indices, batch_noise
from ml.rl.kernels.networks import MlpPolicy

_CHECKPOINT_FORMAT = 2

Curve = dict[str, NDArray[np.float64]]


class TrainingDiverged(ArithmeticError):
    """A loss or value is no longer a finite number."""


class CheckpointError(ValueError):
    """The checkpoint file cannot be read, or belongs to another run."""


class Learner(Protocol):
    """One algorithm: its networks and one gradient step, for K policies side by side."""

    members: int
    uses_noise: bool

    def update(self, batch: TransitionBatch) -> None:
        """Run one update of the networks; the batch stays unchanged."""

    def measure(self, probe: TransitionBatch) -> list[dict[str, float]]:
        """Compute points of the learning curves of each policy: means since the last call, and values on the probe."""

    def policy(self, member: int) -> MlpPolicy:
        """Copy the current state of one policy."""

    def start_values(self, states: NDArray[np.float64], memory: NDArray[np.float64]) -> list[float] | None:
        """Average Q(s, pi(s)) over beta windows [n, W] for each policy, in reward units; None for an algorithm without a critic."""

    def rows(self, member: int) -> dict[str, Any]:
        """Copy one member's weights, by network."""

    def state(self) -> dict[str, Any]:
        """Return everything that the next update depends on (weights, targets, optimisers): tensors, numbers, lists, dictionaries."""

    def load_state(self, state: dict[str, Any]) -> None:
        """Put `state` back."""


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Length of a training, its random numbers, and the times of measurements.

    Attributes:
        updates, batch, record_every, checkpoint_every: as in `TrainConfig`. seeds: one per policy. device: of the tensors.
    """

    updates: int
    batch: int
    seeds: tuple[int, ...]
    record_every: int
    checkpoint_every: int
    device: str = "cpu"


@dataclass
class MemberRecord:
    """Results of the loop for one policy.

    Attributes:
        points: of the learning curves. held_out: points on held-out sessions.
        best_score, best_update, best_rows: the state with the best held-out score; None where nothing scored.
    """

    points: list[dict[str, float]] = field(default_factory=list)
    held_out: list[dict[str, float]] = field(default_factory=list)
    best_score: float | None = None
    best_update: int | None = None
    best_rows: dict[str, Any] | None = None

    def scorings_since_best(self) -> int:
        """Count the scorings after the best one."""
        return sum(point["update"] > (self.best_update or 0) for point in self.held_out)


class _Draws:
    """Batches by update number, drawn in blocks."""

    def __init__(self, learner: Learner, data: PackedTransitions, schedule: Schedule) -> None:
        self._uses_noise, self._data, self._schedule = learner.uses_noise, data, schedule
        self._block = -1
        self._index: Any = None
        self._noise: Any = None

    def batch(self, update: int) -> TransitionBatch:
        """Draw the batch of update 0, 1, ..."""
        block, row = divmod(update, BLOCK)
        if block != self._block:
            p = self._schedule
            index = torch.stack([batch_indices(seed, block, len(self._data), p.batch) for seed in p.seeds], dim=1)
            self._block, self._index = block, index.to(p.device)
            if self._uses_noise:
                self._noise = torch.stack([batch_noise(seed, block, p.batch) for seed in p.seeds], dim=1).to(p.device)
        return self._data.take(self._index[row], self._noise[row] if self._uses_noise else None)


def run(
    learner: Learner,
    data: PackedTransitions,
    schedule: Schedule,
    *,
    fingerprint: str,
    report: Report,
    checkpoint: Path | None = None,
    held_out: HeldOutSessions | None = None,
) -> list[MemberRecord]:
    """Train for `schedule.updates` updates, from the checkpoint where there is one.

    Returns:
        Points and best state of each policy.

    Raises:
        TrainingDiverged: a measured number is not finite.
        CheckpointError: the checkpoint is of another run, or damaged.
    """
    probe, draws = data.probe(learner.members), _Draws(learner, data, schedule)
    starts = held_out.starts() if held_out else None
    done, stopped, records = 0, False, [MemberRecord() for _ in range(learner.members)]
    if checkpoint is not None and checkpoint.exists():
        done, stopped, records = _resume(learner, checkpoint, fingerprint)
    while done < schedule.updates and not stopped:
        learner.update(draws.batch(done))
        done += 1
        last = done == schedule.updates
        if held_out and starts and (done % held_out.every == 0 or last):
            _score(learner, held_out, starts, records, done)
            stopped = 0 < held_out.patience <= min(record.scorings_since_best() for record in records)
        if done % schedule.record_every == 0 or last or stopped:
            _record(learner.measure(probe), records, done, schedule, report)
        if checkpoint is not None and (done % schedule.checkpoint_every == 0 or last or stopped):
            saved = [vars(record) for record in records]
            _save(
                checkpoint, {"fingerprint": fingerprint, "update": done, "stopped": stopped, "outcomes": saved, "learner": learner.state()}
            )
    return records


def as_curve(points: Sequence[dict[str, float]]) -> Curve:
    """Convert points to arrays by name, all of one length; `update` has the update numbers."""
    return {name: np.array([point[name] for point in points]) for name in points[0]} if points else {}


def _record(numbers: list[dict[str, float]], records: list[MemberRecord], done: int, schedule: Schedule, report: Report) -> None:
    shown: dict[str, float] = {}
    for k, (record, own) in enumerate(zip(records, numbers, strict=True)):
        of = f" of policy {k + 1}" if len(records) > 1 else ""
        _require_finite(own, done, of)
        record.points.append({"update": float(done)} | own)
        shown |= own if len(records) == 1 else {f"{name}_{k + 1}": value for name, value in own.items()}
    report(done / schedule.updates, f"update {done} of {schedule.updates}", **shown)


def _score(
    learner: Learner, held_out: HeldOutSessions, starts: tuple[NDArray[np.float64], float], records: list[MemberRecord], done: int
) -> None:
    """Add a point on the held-out sessions for each policy; keeps the eligible state of the best score, the earlier one of equals."""
    states, logged = starts
    values = learner.start_values(states, held_out.start_memory())
    for k, record in enumerate(records):
        point = {"update": float(done)}
        if values is not None:
            point |= {"start_q": values[k], "over_logged": values[k] - logged}
        if held_out.score is not None:
            policy = learner.policy(k)
            score = float(held_out.score(policy))
            _require_finite({"the held-out score": score}, done, f" of policy {k + 1}" if len(records) > 1 else "")
            point["score"] = score
            if values is not None and held_out.is_step_return:
                point["over_estimate"] = values[k] - score
            eligible = held_out.eligible is None or held_out.eligible(policy)
            if eligible and (record.best_score is None or score > record.best_score):
                record.best_score, record.best_update, record.best_rows = score, done, learner.rows(k)
        record.held_out.append(point)


def fingerprint_of(data: PackedTransitions, config: Any, start: dict[str, Any]) -> str:
    """Name a run by its data, its configuration (anything that JSON can express) and its initial weights."""
    digest = hashlib.sha256(json.dumps(config, sort_keys=True).encode())
    digest.update(data.digest().encode())
    for tensor in _tensors(start):
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Limit torch to one thread inside the block: sums then have one order, and two trainings on two cores do not compete."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def tensors_to_bytes(state: dict[str, Any]) -> bytes:
    """Write a nest of dictionaries, lists, numbers and tensors as bytes."""
    sink = io.BytesIO()
    torch.save(state, sink)
    return sink.getvalue()


def tensors_from_bytes(content: bytes) -> dict[str, Any]:
    """Read what `tensors_to_bytes` wrote; runs no code from the bytes. Raises ValueError when they are something else."""
    try:
        state = torch.load(io.BytesIO(content), weights_only=True)
    except Exception as error:  # torch raises pickle, zip, runtime and EOF errors for damaged files
        raise ValueError(f"these bytes hold no stored weights: {error}") from error
    if not isinstance(state, dict):
        raise ValueError("these bytes hold no stored weights: they are not a dictionary of tensors")
    return state


def _resume(learner: Learner, checkpoint: Path, fingerprint: str) -> tuple[int, bool, list[MemberRecord]]:
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
    return int(saved["update"]), bool(saved["stopped"]), [MemberRecord(**record) for record in saved["outcomes"]]


def _save(checkpoint: Path, content: dict[str, Any]) -> None:
    """Replace the checkpoint in one step: a kill at any moment leaves the old one or the new one, whole."""
    part = checkpoint.with_name(checkpoint.name + ".part")
    with part.open("wb") as sink:
        sink.write(tensors_to_bytes({"format": _CHECKPOINT_FORMAT} | content))
        sink.flush()
        os.fsync(sink.fileno())
    part.replace(checkpoint)


def _require_finite(numbers: dict[str, float], update: int, of: str = "") -> None:
    for name, value in numbers.items():
        if not math.isfinite(value):
            raise TrainingDiverged(f"{name}{of} is {value} after update {update}: the training diverged; lower the learning rates")


def _tensors(state: Any) -> Iterator[Any]:
    if isinstance(state, torch.Tensor):
        yield state.detach().cpu().contiguous()
    elif isinstance(state, dict):
        for key in sorted(state, key=str):
            yield from _tensors(state[key])
    elif isinstance(state, list | tuple):
        for item in state:
            yield from _tensors(item)
