"""Data for learners: the buffer in one tensor, rewards on the critic's scale, and batches drawn from a counter."""

from __future__ import annotations

import hashlib
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ml.trajectories import Transitions

BLOCK = 256
"""Batches drawn at once: one call of the generator per block instead of one per update."""
_BATCH_STREAM, _NOISE_STREAM = 1, 4
_PROBE_STATES = 2048


class TransitionBatch(NamedTuple):
    """Rows of a buffer as float32 tensors, B for each of K policies.

    Attributes:
        states, next_states: z-scored windows, [K, B, W].
        actions, rewards: logged amplitude fractions and scaled rewards, [K, B, 1].
        next_actions: the amplitude fraction logged after this one, [K, B, 1]; 0 where none is known.
        next_known: 1 where `next_actions` is known, else 0, [K, B, 1].
        noise: standard normal, [K, B, 1]; None for a learner that uses none.
        remembering, next_remembering: states and next states with the critics' memory of past amplitudes behind, [K, B, W + M]; None
            where they have none.
    """

    states: Any
    actions: Any
    rewards: Any
    next_states: Any
    next_actions: Any
    next_known: Any
    noise: Any = None
    remembering: Any = None
    next_remembering: Any = None

    @property
    def critic_states(self) -> Any:
        """States as the critics see them, [K, B, W + M]."""
        return self.states if self.remembering is None else self.remembering

    @property
    def next_critic_states(self) -> Any:
        """Next states as the critics see them, [K, B, W + M]."""
        return self.next_states if self.next_remembering is None else self.next_remembering


class PackedTransitions:
    """A buffer in one tensor [N, 2 (W + M) + 4], so that a batch is one gather.

    Args:
        states, next_states: z-scored windows, float32 tensors [N, W].
        actions, rewards: float32 tensors [N].
        next_actions: float32 tensor [N], NaN where unknown; None knows none.
        memory: of past amplitudes at the states and at the next states, float32 tensors [N, M]; None for critics that have none.
    """

    def __init__(
        self, states: Any, actions: Any, rewards: Any, next_states: Any, next_actions: Any = None, memory: tuple[Any, Any] | None = None
    ) -> None:
        self._window = states.shape[1]
        self._remembers = memory is not None
        if memory is not None:
            states, next_states = (torch.cat(parts, dim=1) for parts in zip((states, next_states), memory, strict=True))
        self._seen = states.shape[1]
        following = torch.full_like(actions, math.nan) if next_actions is None else next_actions
        known = (~following.isnan()).to(states.dtype)
        columns = [states, actions[:, None], rewards[:, None], next_states, following.nan_to_num(0.0)[:, None], known[:, None]]
        self._rows = torch.cat(columns, dim=1).contiguous()

    def __len__(self) -> int:
        return int(self._rows.shape[0])

    def take(self, index: Any, noise: Any = None) -> TransitionBatch:
        """Copy the rows of an int64 tensor [K, B]; a learner cannot change the buffer through the copy."""
        w, seen = self._window, self._seen
        rows = self._rows.index_select(0, index.reshape(-1)).view(*index.shape, -1)
        now, actions, rewards, after, next_actions, known = rows.split((seen, 1, 1, seen, 1, 1), dim=-1)
        batch = TransitionBatch(now[..., :w], actions, rewards, after[..., :w], next_actions, known, noise)
        return batch._replace(remembering=now, next_remembering=after) if self._remembers else batch

    def probe(self, members: int = 1) -> TransitionBatch:
        """Take up to 2048 rows spread evenly over the buffer, the same for each of K policies, for measurements."""
        index = torch.from_numpy(np.unique(np.linspace(0, len(self) - 1, _PROBE_STATES).astype(np.int64)))
        one = self.take(index[None].to(self._rows.device))
        return TransitionBatch(*(None if column is None else column.expand(members, -1, -1) for column in one))

    def to(self, device: str) -> PackedTransitions:
        """Move the tensor to another device."""
        self._rows = self._rows.to(device)
        return self

    def digest(self) -> str:
        """Compute the SHA-256 of the packed numbers."""
        return hashlib.sha256(self._rows.cpu().numpy().tobytes()).hexdigest()


class RewardScale(NamedTuple):
    """Rewards as the critic sees them: (r - shift) * factor.

    A session's end is a time limit, not a terminal state, so every target bootstraps. An affine change of the rewards is then an affine
    change of every return, Q' = factor (Q - shift / (1 - gamma)). No policy gains or loses by it. The shift is the buffer's mean reward.
    Without it the critic would spend its first ten thousands of updates sinking from 0 to r / (1 - gamma). The factor is sqrt(1 - gamma^2)
    / sd(r). It gives discounted sums of independent rewards a standard deviation of 1. The networks' initial weights and Adam's steps suit
    that scale.
    """

    shift: float
    factor: float
    gamma: float

    @staticmethod
    def of(rewards: NDArray[np.float64], gamma: float) -> RewardScale:
        """Compute the scale of a buffer's rewards, shape [N]; factor 1 where all are equal."""
        deviation = float(rewards.std())
        return RewardScale(float(rewards.mean()), math.sqrt(1 - gamma**2) / deviation if deviation > 1e-12 else 1.0, gamma)

    def scaled(self, rewards: NDArray[np.float64]) -> NDArray[np.float64]:
        """Scale rewards for the critic."""
        return (rewards - self.shift) * self.factor

    def value(self, scaled: float) -> float:
        """Convert a critic's output to the unit of the rewards."""
        return scaled / self.factor + self.shift / (1 - self.gamma)


def packed(transitions: Transitions, normalise: Any, scale: RewardScale, memory: tuple[Any, Any] | None = None) -> PackedTransitions:
    """Pack transitions for learners: windows z-scored by `normalise` (a policy's own), rewards scaled, `memory` as `ml.rl.memory` gives
    it."""
    following = np.full(transitions.actions.size, np.nan)
    consecutive = (np.diff(transitions.session) == 0) & (np.diff(transitions.step) == 1)
    following[:-1][consecutive] = transitions.actions[1:][consecutive]
    return PackedTransitions(
        normalise(torch.tensor(transitions.states, dtype=torch.float32)),
        torch.tensor(transitions.actions, dtype=torch.float32),
        torch.tensor(scale.scaled(transitions.rewards), dtype=torch.float32),
        normalise(torch.tensor(transitions.next_states, dtype=torch.float32)),
        torch.tensor(following, dtype=torch.float32),
        None if memory is None else tuple(torch.tensor(part, dtype=torch.float32) for part in memory),
    )


def batch_indices(seed: int, block: int, size: int, batch: int) -> Any:
    """Draw the rows of the 256 batches of a block, int64 tensor [256, batch], uniformly with replacement from a buffer of `size` rows."""
    return torch.from_numpy(np.random.default_rng([seed, _BATCH_STREAM, block]).integers(0, size, (BLOCK, batch)))


def batch_noise(seed: int, block: int, batch: int) -> Any:
    """Draw standard normals for the 256 batches of a block, float32 tensor [256, batch, 1]."""
    return torch.from_numpy(np.random.default_rng([seed, _NOISE_STREAM, block]).standard_normal((BLOCK, batch, 1), dtype=np.float32))
