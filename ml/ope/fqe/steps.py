"""Usable steps of a buffer in one table with memories of past amplitudes, and the features that value functions are linear in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.ope.doses import DECAYS, after_doses, fresh_memory, held_amplitude, lead_dose, lead_doses, memories, remember
from ml.ope.outcomes.minutes import FEATURES, step_features
from ml.ope.scale import Scale, learn_scale
from ml.policies.policy import Policy
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

RATES = 1 + FEATURES
"""Columns of `UsableSteps.rates`: r_k, and what outcomes follow (`outcomes.minutes.step_features`) of a_k and the beta of the row."""


@dataclass(frozen=True)
class UsableSteps:
    """Usable steps, session by session; N steps, n sessions, window W.

    Attributes:
        scale: standardisation of beta.
        states, next_states: s_k and s_{k+1}, participant's unit, [N, W].
        actions: a_k, [N]. memory: memories of the amplitudes up to and with a_k, [N, 3].
        rates: see `RATES`, [N, R].
        session: index of the session, [N]. step: k, [N].
        follows: row of the next step of the same session where that is usable too, else -1, [N].
        first_states: s_0 of the sessions without gaps in it, [m, W]. first_session: their indices, [m].
        sessions: n.
        before: amplitude that had been on before the sessions of `first_session`, [m]; NaN: their first one.
        otherwise: amplitude that had been on before sessions of which no record says it; None: their first (`ml.ope.lead`).
    """

    scale: Scale
    states: Floats
    next_states: Floats
    actions: Floats
    memory: Floats
    rates: Floats
    session: Indices
    step: Indices
    follows: Indices
    first_states: Floats
    first_session: Indices
    sessions: int
    before: Floats
    otherwise: float | None = None

    def first_memory(self, a: Floats, sessions: Sequence[SessionTrajectory] | None = None) -> Floats:
        """Compute memories [m, 3] at the first step under the amplitudes [m] of the table's first sessions, or of other ones, after their
        doses."""
        before = self.before if sessions is None else lead_doses(sessions, self.otherwise)
        return remember(fresh_memory(after_doses(a, before)), a)


def usable_steps(buffer: ReplayBuffer, scale: Scale | None = None, otherwise: float | None = None) -> UsableSteps:
    """Build the table of a buffer; `otherwise` is the dose before sessions without a record of it.

    Raises:
        ValueError: no step is usable, or no session starts without gaps.
    """
    settings = buffer.settings
    scale = learn_scale(buffer) if scale is None else scale
    steps = buffer.transitions()
    memory = np.concatenate([memories(held_amplitude(s), lead_dose(s, otherwise))[s.usable()] for s in buffer.sessions])
    beta = steps.next_states[:, -1]
    rates = np.concatenate([steps.rewards[:, None], step_features(beta, steps.actions, settings.xi_beta)], axis=1)
    next_row = np.arange(1, len(beta) + 1)
    joined = np.append((np.diff(steps.session) == 0) & (np.diff(steps.step) == 1), False)
    starts = [(i, s.lead_beta) for i, s in enumerate(buffer.sessions) if np.isfinite(s.lead_beta).all()]
    if not starts:
        raise ValueError("no session has a complete window of beta before its first step: there is no s_0 to start from")
    return UsableSteps(
        scale=scale,
        states=steps.states,
        next_states=steps.next_states,
        actions=steps.actions,
        memory=memory,
        rates=rates,
        session=steps.session,
        step=steps.step,
        follows=np.where(joined, next_row, -1),
        first_states=np.stack([lead for _, lead in starts]),
        first_session=np.array([i for i, _ in starts], dtype=np.int64),
        sessions=len(buffer.sessions),
        before=lead_doses([buffer.sessions[i] for i, _ in starts], otherwise),
        otherwise=otherwise,
    )


class ValueFeatures:
    """Features of (s, a, memory) that a value function is linear in: polynomial ones, and random tanh units of a few summaries.

    Args:
        table: whose steps set the scales.
        units: number of random units. seed: of their weights.
    """

    def __init__(self, table: UsableSteps, units: int = 48, seed: int = 0) -> None:
        self.scale = table.scale
        rng = np.random.default_rng([seed, 0xFEA7])
        self._inner = rng.normal(size=(_SUMMARIES, units)) * np.array([1, 1, 1, 2, 1, 1, 1])[:, None] / 2
        self._offset = rng.uniform(-1.5, 1.5, units)
        self._centre, self._spread = np.zeros(1), np.ones(1)
        raw = self._raw(table.states, table.actions, table.memory)
        self._centre, self._spread = raw.mean(0), np.maximum(raw.std(0), 1e-6)
        self._spread[raw.std(0) < 1e-6] = 1.0

    def __call__(self, states: Floats, actions: Floats, memory: Floats) -> Floats:
        """Compute features [N, F], the first of them constant, the others centred and of unit spread over the logged steps."""
        raw = self._raw(states, actions, memory)
        return np.concatenate([np.ones((len(raw), 1)), (raw - self._centre) / self._spread], axis=1)

    def _raw(self, states: Floats, a: Floats, memory: Floats) -> Floats:
        window = self.scale.beta(states)
        newest = window[:, -1]
        columns = [window, np.stack([a, a**2, a * newest], axis=1), memory, memory**2, memory * newest[:, None]]
        level = np.stack([newest, window[:, -3:].mean(1), window.mean(1)], axis=1)
        inputs = np.concatenate([level, 3 * (a[:, None] - 0.5), 3 * (memory - 0.5)], axis=1)
        return np.concatenate([*columns, np.tanh(inputs @ self._inner + self._offset)], axis=1)


_SUMMARIES = 3 + 1 + len(DECAYS)


@dataclass(frozen=True)
class TargetActions:
    """Actions of a policy at the states of a table; computed once, because the policy is fixed.

    Attributes:
        at: pi(s_k), [N]. then: pi(s_{k+1}), [N]. memory: of that next step, [N, 3]. first: pi(s_0), [m].
    """

    at: Floats
    then: Floats
    memory: Floats
    first: Floats

    @classmethod
    def of(cls, table: UsableSteps, policy: Policy) -> TargetActions:
        """Compute the actions of a policy on a table."""
        then = _act(policy, table.next_states)
        return cls(_act(policy, table.states), then, remember(table.memory, then), _act(policy, table.first_states))

    @property
    def span(self) -> tuple[float, float]:
        """Least and largest amplitude that the policy asks for in a logged state."""
        asked = np.concatenate([self.at, self.then, self.first])
        return float(asked.min()), float(asked.max())


def _act(policy: Policy, states: NDArray[Any]) -> Floats:
    return np.clip(np.asarray(policy.act(states.copy()), dtype=np.float64), 0.0, 1.0)
