"""One session of the study in silico: simulated, uploaded as a patient's file would be, and rated."""

from __future__ import annotations

import datetime as dt
import io
from dataclasses import dataclass

import numpy as np
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.ingest.uploads import service as ingest
from app.learning.models import Policy
from app.planning.plans.designs import Planned
from app.platform import files
from app.platform.errors import BetaloopError
from app.simulation.demo_study import device_session, session_file
from app.study import repository as study_repository
from app.study import service as study
from app.study.models import Controller, Participant, StudySession, Visit
from app.study.schemas import ConditionsChange, DesignParameters, QocIn
from app.study.sessions import conditions
from app.study.sessions.data import qoc_of, session_data
from app.study.threshold import mdp_settings
from ml.mdp import end_reward, step_reward
from ml.policies.onnx_policy import OnnxPolicy
from ml.population import SimulatedSession, run_session
from ml.population.controllers import Controller as CohortController
from ml.returns import ActualReturn, step_return

RESOLUTION_MA = 0.1
"""What an RC+S delivers."""


@dataclass(frozen=True, kw_only=True)
class PlacedSession:
    """A session of a visit day: `position` counts from 1, `hour` from the day's first session; `design`: of a random one of held draws."""

    position: int
    controller: Controller
    policy: Policy | None
    begins: dt.datetime
    hour: float
    steps: int
    design: Planned | None = None


def simulate(participant: Participant, visit: Visit, placed: PlacedSession, seed: int) -> SimulatedSession:
    """The session's numbers: the same whenever it is asked for."""
    settings = mdp_settings(participant.current_settings)
    controller: CohortController
    if placed.policy is not None:
        controller = OnnxPolicy(files.read(placed.policy.onnx_sha256), settings.window)
    elif placed.design is not None:
        controller = placed.design.first_steps(placed.steps)
    else:
        controller = placed.controller.value  # type: ignore[assignment]
    return run_session(
        participant.code,
        controller,
        visit=visit.number,
        hour=placed.hour,
        seed=int(np.random.default_rng([seed, visit.number, placed.position]).integers(0, 2**63)),
        steps=placed.steps,
        lead_steps=settings.window,
        lower_bound=settings.lower_bound,
        resolution_ma=RESOLUTION_MA,
        study_seed=seed,
        name=placed.controller.value,
    )


def hold(db: Session, participant: Participant, visit: Visit, placed: PlacedSession, seed: int, caller: Caller) -> None:
    """Hold a session: upload its file and enter its QoCs; what is there already is left as it is. Commits.

    Raises:
        BetaloopError: the file was not understood, which would be a fault of the decoder or of the simulator.
    """
    held = _session_at(db, visit, placed.position)
    if held is not None and held.qoc is not None:
        return
    simulated = simulate(participant, visit, placed, seed)
    if held is None:
        name, content = session_file(f"{participant.code}-visit{visit.number}-session{placed.position}", simulated, placed.begins)
        stated = ingest.state_session(
            db,
            participant,
            visit.number,
            placed.controller,
            None if placed.policy is None else str(placed.policy.id),
            placed.begins if device_session(participant.code) else None,
        )
        outcome = ingest.receive(db, participant, stated, [ingest.Incoming(name, io.BytesIO(content))], caller)
        if not outcome.usable:
            problems = "; ".join(str(r.problem) for f in outcome.files for r in f.reports if r.problem)
            raise BetaloopError(f"The simulated file {name} was not understood: {problems}.")
        held = _session_at(db, visit, placed.position)
        if held is None:
            raise BetaloopError(f"The simulated file {name} made no session at place {placed.position} of visit {visit.number}.")
    if placed.design is not None:
        conditions.change(db, held, _stated(placed.design), caller)
    qoc = simulated.qoc
    values = {"grasp_hz": qoc.grasp_hz, "rating": simulated.rating, "tremor_percent": qoc.tremor_percent}
    study.record_qoc(db, held, QocIn.model_validate(values | {"sure": list(values)}), caller)
    db.commit()


def _stated(design: Planned) -> ConditionsChange:
    return ConditionsChange(
        design=design.design,
        seed=design.seed,
        design_parameters=DesignParameters.model_validate({"level": design.level, "holds": design.as_json()["holds"]}),
        reason="laid out by the simulated study",
    )


def actual_return(db: Session, session: StudySession) -> float | None:
    """What a session brought over all its steps, by the rule of `ml.returns` for gaps; None without its QoCs or with too many gaps."""
    settings = mdp_settings(session.visit.participant.current_settings)
    table = session_data(db, session).table
    during = table.t_s > 0
    rewards = step_reward(settings, table.beta[during], table.fraction[during])
    return ActualReturn(step_return(rewards, settings.gamma, rewards.size), end_reward(settings, qoc_of(session))).value


def _session_at(db: Session, visit: Visit, position: int) -> StudySession | None:
    db.expire_all()
    return next((s for s in study_repository.sessions_of_visit(db, visit.id)[0] if s.ordinal == position), None)
