"""Visit days of a synthetic participant: the sessions that take place, by the rules of the paper's trials, and the replay buffers they
leave.

Rules (Gao et al. 2023, section 6.1). Sessions last 5-20 minutes; 2-4 policies are tested on a day. A cDBS session comes between any two
sessions of learned policies. No-DBS sessions are few and last 5 minutes. A uniformly random controller on [B, 1] is used early on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ml.mdp import MdpSettings
from ml.policies.policy import Policy
from ml.population.controllers import Controller
from ml.population.participants import PARTICIPANTS, ParticipantModel
from ml.population.sessions import SimulatedSession, run_sessions
from ml.progress import Report, silent
from ml.trajectories import ReplayBuffer, SessionTrajectory

BETA_SOURCE: Final = "time_domain"
BETA_UNIT: Final = "uV"
MAX_POLICIES: Final = 4
NO_DBS_STEPS: Final = 150
SESSION_STEPS: Final = (150, 600)
"""Shortest and longest session: 5 and 20 minutes."""
PAUSE_H: Final = 10.0 / 60.0
"""Between two sessions of a day: rating, rest, the next controller; assumed."""
STEP_H: Final = 2.0 / 3600.0


@dataclass(frozen=True, kw_only=True)
class PlannedSession:
    """A session of a visit day.

    Attributes:
        controller: `cdbs`, `no_dbs`, `random` or `rl`. policy: name of the policy of an `rl` session.
        hour: since the first session of the day. steps: of 2 s.
    """

    controller: str
    policy: str | None
    hour: float
    steps: int


def plan_day(
    policies: Sequence[str], *, steps: int = 300, random_sessions: int = 0, no_dbs: bool = True, seed: int = 0
) -> list[PlannedSession]:
    """Lay out a visit day: cDBS first, then each policy or random session followed by cDBS, a short no-DBS session at the end.

    Args:
        policies: names of 0-4 policies. steps: length of a session, 150-600.
        random_sessions: sessions of the random controller. seed: of the order.

    Raises:
        ValueError: more than four policies, the same one twice, or a session outside 5-20 minutes.
    """
    if len(policies) > MAX_POLICIES or len(set(policies)) < len(policies):
        raise ValueError(f"a visit day tests up to {MAX_POLICIES} different policies, not {', '.join(policies)}")
    if not SESSION_STEPS[0] <= steps <= SESSION_STEPS[1]:
        raise ValueError(f"a session lasts {SESSION_STEPS[0]} to {SESSION_STEPS[1]} steps (5-20 minutes), not {steps}")
    tests: list[tuple[str, str | None]] = [("rl", name) for name in policies] + [("random", None)] * random_sessions
    order = [("cdbs", None)]
    for i in np.random.default_rng([seed, 0x646179]).permutation(len(tests)):
        order += [tests[i], ("cdbs", None)]
    if no_dbs:
        order.append(("no_dbs", None))
    day, hour = [], 0.0
    for controller, policy in order:
        length = NO_DBS_STEPS if controller == "no_dbs" else steps
        day.append(PlannedSession(controller=controller, policy=policy, hour=hour, steps=length))
        hour += length * STEP_H + PAUSE_H
    return day


def run_day(
    participant: ParticipantModel | str,
    day: Sequence[PlannedSession],
    policies: Mapping[str, Policy],
    *,
    visit: int,
    seed: int,
    settings: MdpSettings,
    resolution_ma: float | None = None,
    keep_lfp: bool = False,
    report: Report = silent,
) -> list[SimulatedSession]:
    """Run the sessions of a visit day; `policies` by the names in the plan, `seed` is the study's."""
    sessions = []
    for number, planned in enumerate(day):
        controller: Controller = policies[planned.policy] if planned.policy is not None else planned.controller  # type: ignore[assignment]
        batch = run_sessions(
            participant,
            controller,
            visits=visit,
            hours=planned.hour,
            seeds=[_session_seed(seed, visit, number)],
            steps=planned.steps,
            lead_steps=settings.window,
            bound=settings.bound,
            resolution_ma=resolution_ma,
            study_seed=seed,
            keep_lfp=keep_lfp,
        )
        sessions.append(batch.session(0))
        report((number + 1) / len(day), f"visit {visit}: {planned.controller}")
    return sessions


def random_controller_buffer(
    participant: ParticipantModel | str,
    visits: int,
    sessions_per_visit: int,
    steps: int,
    seed: int,
    *,
    settings: MdpSettings | None = None,
    threads: int = 1,
) -> ReplayBuffer:
    """Simulate a replay buffer of early visits: mostly random sessions, each third cDBS, one short no-DBS session per visit from the third
    on.

    Args:
        participant: who. visits: number of visit days. sessions_per_visit: random and cDBS sessions of each. steps: T of these sessions.
        seed: of days and noise; sessions do not depend on how many there are.
        settings: MDP constants; those suggested for the participant, with xi_beta midway between cDBS and amplitude 0.3, by default.

    Returns:
        Sessions in the order they took place; beta in uV.
    """
    model = PARTICIPANTS[participant] if isinstance(participant, str) else participant
    constants = model.mdp_settings() if settings is None else settings
    plan = [row for visit in range(1, visits + 1) for row in _early_visit(visit, sessions_per_visit, steps)]
    trajectories: dict[int, SessionTrajectory] = {}
    for controller, length in sorted({(row.controller, row.steps) for row in plan}):
        own = [i for i, row in enumerate(plan) if (row.controller, row.steps) == (controller, length)]
        batch = run_sessions(
            model,
            controller,  # type: ignore[arg-type]
            visits=[plan[i].visit for i in own],
            hours=[plan[i].hour for i in own],
            seeds=[_session_seed(seed, plan[i].visit, plan[i].number) for i in own],
            steps=length,
            lead_steps=constants.window,
            bound=constants.bound,
            study_seed=seed,
            threads=threads,
        )
        for place, i in enumerate(own):
            trajectories[i] = batch.session(place).trajectory(session_id=i + 1)
    return ReplayBuffer(constants, tuple(trajectories[i] for i in range(len(plan))), BETA_UNIT, BETA_SOURCE)


@dataclass(frozen=True)
class _EarlySession:
    visit: int
    number: int
    controller: str
    hour: float
    steps: int


def _early_visit(visit: int, sessions: int, steps: int) -> list[_EarlySession]:
    rows, hour = [], 0.0
    for number in range(sessions + int(visit % 3 == 0)):
        controller = "no_dbs" if number == sessions else "cdbs" if number % 3 == 2 else "random"
        length = min(steps, NO_DBS_STEPS) if controller == "no_dbs" else steps
        rows.append(_EarlySession(visit, number, controller, hour, length))
        hour += length * STEP_H + PAUSE_H
    return rows


def _session_seed(seed: int, visit: int, number: int) -> int:
    return int(np.random.default_rng([seed, visit, number]).integers(0, 2**63))
