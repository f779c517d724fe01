"""A buffer's sessions as padded, standardised tensors, time first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ml.ope.scale import Scale, outcome_table
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Batch:
    """Sessions padded to the longest, time first. B sessions, T steps, window W.

    Attributes:
        states: s_0 ... s_T standardised, gaps filled with the last valid beta, [T + 1, B, W].
        actions: a_0 ... a_{T-1}, unknown ones taken from before, [T, B].
        rewards: r_0 ... r_{T-1}, standardised, [T, B].
        alive: 1 where the session has this step, [T, B].
        usable: 1 where the step may be learnt from, [T, B]; never beyond `alive`.
        first_known: 1 where s_0 is free of gaps, [B].
        lengths: T of each session, [B].
        randomised: 1 where the session's doses were drawn at random, [B].
        left, resting: `LinearPart.of`, [T, B] and [W + T, B]; None without a linear part.
        outcomes, outcome_mask: `OUTCOMES` standardised and whether they were measured, [B, 4].
    """

    states: Tensor
    actions: Tensor
    rewards: Tensor
    alive: Tensor
    usable: Tensor
    first_known: Tensor
    lengths: Tensor
    outcomes: Tensor
    outcome_mask: Tensor
    randomised: Tensor
    left: Tensor | None = None
    resting: Tensor | None = None

    @property
    def size(self) -> tuple[int, int]:
        """T and B."""
        return int(self.actions.shape[0]), int(self.actions.shape[1])

    def select(self, columns: Sequence[int]) -> Batch:
        """Select some of the sessions, cut to the longest of them."""
        index = torch.as_tensor(list(columns), dtype=torch.long)
        lengths = self.lengths[index]
        t = int(lengths.max())
        return Batch(
            self.states[: t + 1, index],
            self.actions[:t, index],
            self.rewards[:t, index],
            self.alive[:t, index],
            self.usable[:t, index],
            self.first_known[index],
            lengths,
            self.outcomes[index],
            self.outcome_mask[index],
            self.randomised[index],
            None if self.left is None else self.left[:t, index],
            None if self.resting is None else self.resting[: t + self.states.shape[2], index],
        )

    def cut(self, steps: int) -> Batch:
        """Cut the batch to its first steps."""
        window = self.states.shape[2]
        return replace(
            self,
            states=self.states[: steps + 1],
            **{name: getattr(self, name)[:steps] for name in ("actions", "rewards", "alive", "usable")},
            lengths=self.lengths.clamp(max=steps),
            left=None if self.left is None else self.left[:steps],
            resting=None if self.resting is None else self.resting[: window + steps],
        )


def make_batch(buffer: ReplayBuffer, scale: Scale, dtype: torch.dtype = torch.float32) -> Batch:
    """Make one padded batch of all sessions of a buffer."""
    settings, sessions = buffer.settings, buffer.sessions
    longest, n, w = max(s.steps for s in sessions), len(sessions), settings.window
    states = np.zeros((longest + 1, n, w))
    actions, rewards, alive, usable = (np.zeros((longest, n)) for _ in range(4))
    first_known = np.zeros(n)
    for i, s in enumerate(sessions):
        t = s.steps
        filled = _fill_gaps(scale.beta(s.padded_beta), start=0.0)
        states[: t + 1, i] = np.lib.stride_tricks.sliding_window_view(filled, w)
        actions[:t, i] = _fill_gaps(s.amplitude, start=0.0)
        alive[:t, i] = 1.0
        ok = s.usable()
        usable[:t, i] = ok
        rewards[:t, i] = np.where(ok, (s.rewards(settings) - scale.reward_mean) / scale.reward_std, 0.0)
        first_known[i] = float(np.isfinite(s.lead_beta).all())
    spread = np.array(scale.outcome_std)
    outcomes = (outcome_table(buffer) - np.array(scale.outcome_mean)) / np.where(spread > 0, spread, 1.0)
    # An outcome that is the same for all, as r_end where nothing counts in it, has nothing to be learnt or scored by.
    mask = np.isfinite(outcomes) & np.array(scale.outcome_seen) & (spread > 0)

    def tensor(values: NDArray[Any]) -> Tensor:
        return torch.as_tensor(values, dtype=dtype)

    return Batch(
        tensor(states),
        tensor(actions),
        tensor(rewards),
        tensor(alive),
        tensor(usable),
        tensor(first_known),
        torch.as_tensor([s.steps for s in sessions], dtype=torch.long),
        tensor(np.where(mask, outcomes, 0.0)),
        tensor(mask),
        tensor(np.array([s.controller == "random" for s in sessions])),
    )


def _fill_gaps(values: Floats, start: float) -> Floats:
    """Fill gaps with the value before them; gaps at the start with the first valid value, or `start` where there is none."""
    valid = np.isfinite(values)
    if valid.all():
        return values
    if not valid.any():
        return np.full_like(values, start)
    last = np.maximum.accumulate(np.where(valid, np.arange(values.size), -1))
    return values[np.where(last < 0, int(np.argmax(valid)), last)]
