"""Each step's share of the end-of-session reward, so that a critic may sum what the study values and not beta and energy alone.

The paper leaves QoCs out of training, because one number per session is sparse (Gao et al. 2023, remark 1). Evaluation reconstructs step
rewards from an end-of-session one (off-policy evaluation for human feedback, Gao et al., NeurIPS 2023). Here the model of outcomes that
evaluation uses (`ml.ope.outcomes`) is divided into steps. One dose is worth more where symptoms are near; it saturates, and it
over-stimulates. Visits have levels of their own, so that contrasts within a day count for more than a good day with a low amplitude by
chance.

A critic sums without end and discounts. So a share enters as (1 - gamma) / (1 - gamma^H) of it, H the median session. Steps and r_end then
have the same proportion as in the return of eq:ope_total_return.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ml.mdp import MdpSettings
from ml.ope.outcomes.model import EndModel, LeftOut, fit_end_model
from ml.ope.outcomes.steps import end_reward_by_step
from ml.ope.scale import outcome_table
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]

FEWEST_SESSIONS = 8
"""Sessions with an r_end below which no share is learnt: slopes from fewer say nothing."""


@dataclass(frozen=True)
class EndReward:
    """A fitted share.

    Attributes:
        model: of the outcomes, with constants of 0 where a QoC is excluded. level: the average share of the excluded ones in r_end.
        settings: of the MDP. factor: (1 - gamma) / (1 - gamma^H).
        skill: 1 - squared error of r_end of held-out sessions / that of predicting the mean. visit_skill: the same of held-out visits. Its
            mean is that of the other visits; None with one visit.
        sessions: with an r_end.
    """

    model: EndModel
    level: float
    settings: MdpSettings
    factor: float
    skill: float
    visit_skill: float | None
    sessions: int

    def per_step(self, session: SessionTrajectory) -> Floats:
        """Compute what every step adds to its reward, [T]; NaN where amplitude or beta is unknown."""
        return self.factor * (self.level + end_reward_by_step(self.model, session, self.settings))


def fit_end_reward(buffer: ReplayBuffer) -> EndReward | None:
    """Learn the share from the QoCs that are predicted better than by their mean; None without one, or with too few sessions.

    Too few are fewer than `FEWEST_SESSIONS` with an r_end. A QoC that nothing predicts, such as a noisy rating, is excluded, so that it
    does not hide the others. None too where the remaining ones predict r_end no better than its mean. Skill on held-out sessions or on
    held-out visits is enough: noise of sessions may hide it in one, differences between days in the other.
    """
    settings = buffer.settings
    rated = sum(s.end_reward(settings) is not None and bool(s.usable().any()) for s in buffer.sessions)
    if settings.c2 + settings.c3 + settings.c4 == 0 or rated < FEWEST_SESSIONS:
        return None
    model = fit_end_model(buffer)
    table = outcome_table(buffer)[:, 1:]
    ways = [model.by_session, model.by_visit][: min(2, len({s.visit for s in buffer.sessions}))]
    told = np.array([model.seen[k] and any(left.skill[k] > 0 for left in ways) for k in (1, 2, 3)])
    constants = np.where(told, model.constants, 0.0)
    skills = [_skill(model, left, constants, table) for left in ways]
    if not constants.any() or max(skills) <= 0:
        return None
    factor = (1 - settings.gamma) / (1 - settings.gamma ** buffer.median_steps())
    shared = replace(model, constants=constants, seen=(True, *model.seen[1:]))
    left = model.constants != constants
    level = float(np.nanmean(table[:, left], axis=0) @ model.constants[left])
    return EndReward(shared, level, settings, factor, skills[0], skills[1] if len(skills) > 1 else None, rated)


def _skill(model: EndModel, left: LeftOut, constants: Floats, table: Floats) -> float:
    """Compute `EndReward.skill` or `visit_skill`, where only QoCs with a constant that is not 0 are predicted; table [n, 3]."""
    counted, by_model = model.constants != 0, constants != 0
    said = np.where(by_model, left.predicted[:, 1:], left.mean[:, 1:])[:, counted]
    known = np.isfinite(table[:, counted]).all(1) & np.isfinite(said).all(1) & np.isfinite(left.mean[:, 1:][:, counted]).all(1)
    if not known.any():
        return 0.0
    ends, guessed, mean = (v[known] @ model.constants[counted] for v in (table[:, counted], said, left.mean[:, 1:][:, counted]))
    without = float(np.mean((ends - mean) ** 2))
    return 1 - float(np.mean((ends - guessed) ** 2)) / without if without > 0 else 0.0
