"""Sessions that a training does not see: what they say of the policy on its way, and which of its states is chosen.

Nothing here knows a true return. A score is an estimate from held-out sessions that the caller supplies, such as fitted Q evaluation.
(`ml.ope` uses this package, so this package cannot use it.) Choosing by a score uses the sessions up. An estimate from the same sessions
flatters the chosen state and is no evidence for deployment.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ml.policies.policy import Policy, Score
from ml.rl.end_reward import EndReward
from ml.rl.memory import remembered
from ml.trajectories import ReplayBuffer, to_parquet

_SPLIT_STREAM = 5


@dataclass(frozen=True, kw_only=True)
class HeldOutSessions:
    """Held-out sessions that monitor a training from outside its data.

    Attributes:
        sessions: the held-out sessions.
        score: estimate by which the best state is chosen; None takes the last.
        score_name: names the estimate; part of what a checkpoint belongs to.
        eligible: decides whether a state may be chosen for its score, such as `ml.policies.logged_range.stays_in_range`. Beyond the data an
            estimate is free to be large, and the best score would find that state. None allows every state; where none is eligible, the
            last stays.
        is_step_return: whether `score` estimates the discounted sum of step rewards without end, from the sessions' first states; only
            then is Q's distance from it an over-estimation.
        end_reward: what every step adds where the critic's sum holds a share of r_end too; set by the trainer.
        every: updates between two scorings.
        patience: scorings without a better one after which the training stops; 0 never stops.

    Raises:
        ValueError: `every` below 1 or `patience` below 0.
    """

    sessions: ReplayBuffer
    score: Score | None = None
    score_name: str = ""
    eligible: Callable[[Policy], bool] | None = None
    is_step_return: bool = False
    end_reward: EndReward | None = None
    every: int = 500
    patience: int = 0

    def __post_init__(self) -> None:
        if self.every < 1 or self.patience < 0:
            raise ValueError(f"every must be 1 or more and patience 0 or more, not {self.every} and {self.patience}")

    def starts(self) -> tuple[NDArray[np.float64], float]:
        """Return the first usable states of the sessions, shape [n, W], and the mean discounted return logged from them.

        The return is that of the remaining usable steps, followed by the session's mean reward for ever. A critic that bootstraps through
        the end of a session estimates such an endless sum. Raises ValueError when no session has a usable step.
        """
        gamma = self.sessions.settings.gamma
        states, returns = [], []
        for session in self.sessions.sessions:
            usable = np.flatnonzero(session.usable())
            if usable.size == 0:
                continue
            rewards = session.rewards(self.sessions.settings)
            if self.end_reward is not None:
                rewards = rewards + self.end_reward.per_step(session)
            first, mean = int(usable[0]), float(rewards[usable].mean())
            # A gap within the session counts as its mean reward.
            filled = np.where(session.usable(), rewards, mean)[first:]
            tail = gamma**filled.size * mean / (1 - gamma)
            states.append(session.states()[first])
            returns.append(float(filled @ gamma ** np.arange(filled.size)) + tail)
        if not states:
            raise ValueError("no held-out session has a usable step")
        return np.stack(states), float(np.mean(returns))

    def start_memory(self) -> NDArray[np.float64]:
        """Return past amplitudes at the states of `starts`, [n, M], for critics that remember them."""
        used = [(s, np.flatnonzero(s.usable())) for s in self.sessions.sessions]
        return np.stack([remembered(s, self.sessions.settings.period_s)[k[0]] for s, k in used if k.size])

    def name(self) -> str:
        """Name the sessions and the rule, for checkpoints."""
        digest = hashlib.sha256(to_parquet(self.sessions)).hexdigest()
        return f"{digest} {self.score_name} {self.score is not None} {self.eligible is not None} {self.every} {self.patience}"


def split_sessions(buffer: ReplayBuffer, share: float = 0.2, seed: int = 0) -> tuple[ReplayBuffer, ReplayBuffer]:
    """Split sessions into those for training and held-out ones. They are drawn within each controller, so that both sides have every kind
    with two sessions.

    Args:
        buffer: the sessions; a session is never divided.
        share: of the held-out sessions of each controller, rounded; at least one session in all.
        seed: of the draw.

    Raises:
        ValueError: a share outside (0, 1), or fewer than two sessions.
    """
    if not 0 < share < 1:
        raise ValueError(f"the held-out share must lie in (0, 1), not {share}")
    if len(buffer.sessions) < 2:
        raise ValueError("holding sessions out needs two sessions or more; the buffer has one")
    rng = np.random.default_rng([seed, _SPLIT_STREAM])
    groups: dict[str, list[int]] = {}
    for i, session in enumerate(buffer.sessions):
        groups.setdefault(session.controller, []).append(i)
    out: set[int] = set()
    for _, members in sorted(groups.items()):
        count = min(math.floor(share * len(members) + 0.5), len(members) - 1)
        out |= {members[i] for i in rng.permutation(len(members))[:count]}
    if not out:
        out = {int(rng.integers(len(buffer.sessions)))}
    learnt = tuple(s for i, s in enumerate(buffer.sessions) if i not in out)
    left = tuple(s for i, s in enumerate(buffer.sessions) if i in out)
    return replace(buffer, sessions=learnt), replace(buffer, sessions=left)
