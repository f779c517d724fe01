"""A quick score of a policy by fitted Q evaluation, for learning sweeps: on held-out sessions, without their returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ml.ope.estimate import checked_horizon
from ml.ope.fqe.estimator import QMember, fit_member, minutes_of, within_reach
from ml.ope.fqe.steps import TargetActions, usable_steps
from ml.ope.lead import dose_before
from ml.ope.outcomes.model import fit_end_model
from ml.ope.scale import learn_scale, session_folds
from ml.policies.policy import Policy
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FqeScore:
    """A quick score of one policy for learning sweeps.

    Attributes:
        value: expected return from the left-out sessions' s_0, r_end included where it can be learnt.
        step_return, end_reward: its parts; r_end is 0 where fewer than three sessions have one.
        residual: mean one-step error of the value function on the left-out sessions, r + gamma V - Q; far from 0: do not trust the value.
    """

    value: float
    step_return: float
    end_reward: float
    residual: float


def fqe_value(
    buffer_train: ReplayBuffer,
    policy: Policy,
    held_out_sessions: Sequence[SessionTrajectory],
    horizon_steps: int | None = None,
    *,
    units: int = 48,
    seed: int = 0,
) -> FqeScore:
    """Score a policy on held-out sessions of its training, in a fraction of a second; deterministic.

    The value function is fitted to the training sessions and read at the s_0 of the held-out ones. Where no held-out session starts without
    gaps, it is read at those of the training sessions.

    Raises:
        ValueError: no usable step in the training sessions, or none of all sessions starts without gaps.
    """
    settings, sessions = buffer_train.settings, tuple(held_out_sessions)
    horizon = checked_horizon(buffer_train, horizon_steps)
    scale = learn_scale(buffer_train)
    table = usable_steps(buffer_train, scale, dose_before(buffer_train))
    member = fit_member(table, session_folds(buffer_train.sessions, 3, seed), settings.gamma, units, seed)
    target = TargetActions.of(table, policy)
    weights, _ = member.weights(member.next_products(target), np.arange(table.sessions), horizon, settings.gamma)
    own = [s for s in sessions if np.isfinite(s.lead_beta).all()]
    first = np.stack([s.lead_beta for s in own]) if own else table.first_states
    actions = np.clip(policy.act(first.copy()), 0.0, 1.0)
    sums = member.features(first, actions, table.first_memory(actions, own or None)).mean(0) @ weights[-1]
    sums = within_reach(sums, settings, horizon, (scale.beta_low, scale.beta_high), target.span)
    end_model = fit_end_model(buffer_train)
    end = float(end_model.predict(minutes_of(sums, horizon))[0]) if end_model.seen[0] else 0.0
    return FqeScore(float(sums[0]) + end, float(sums[0]), end, _residual(buffer_train, sessions, policy, member, weights))


def _residual(
    buffer: ReplayBuffer,
    sessions: tuple[SessionTrajectory, ...],
    policy: Policy,
    member: QMember,
    weights: Floats,
) -> float:
    usable = tuple(s for s in sessions if s.usable().any() and np.isfinite(s.lead_beta).all())
    if not usable:
        return 0.0
    part = replace(buffer, sessions=usable)
    held = usable_steps(part, member.features.scale, member.grams.table.otherwise)
    target = TargetActions.of(held, policy)
    now = member.features(held.states, held.actions, held.memory) @ weights[-1][:, 0]
    then = member.features(held.next_states, target.then, target.memory) @ weights[-2][:, 0]
    return float(np.mean(held.rates[:, 0] + buffer.settings.gamma * then - now))
