"""Logs of controllers: the policy that decided, the limits that it ran within, and the slot of a signed plan that it ran for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.study import repository
from app.tables.plans import SEALED, Plan, PlanItem
from app.tables.recordings import Recording
from app.tables.sessions import Controller, StudySession
from app.tables.visits import Visit

LEAST_SHARE = 0.7
"""Share of decisions by its policy or schedule below which a session counts for none; ours, as the least coverage of a step."""
CONTROLLER_OF_KIND = {"distilled": Controller.DISTILLED, "baseline": Controller.OTHER}
"""Controllers of policies by their kind; those of every other kind are RL."""


@dataclass(frozen=True)
class Logged:
    """Policy that ran, by the controller's own log.

    Attributes:
        policy_id, policy_name, controller: of the participant's policy with the logged network; None where the participant has none.
        number: of the policy in the installation that made the bundle.
        min_ma, max_ma, cdbs_ma: of the bundle.
    """

    policy_id: int | None
    policy_name: str | None
    controller: Controller | None
    number: int
    min_ma: float
    max_ma: float
    cdbs_ma: float


def of_recording(db: Session, recording: Recording) -> Logged | None:
    """Read the controller of a recording; None where it is no log, or a log that does not name one."""
    said = limits_and_policy(recording)
    if said is None or said["network_sha256"] is None:  # a schedule has no policy
        return None
    same = repository.policies_of_network(db, recording.participant_id, said["network_sha256"])
    policy = next((p for p in same if p.id == said["policy_id"]), same[0] if same else None)
    return Logged(
        policy_id=policy.id if policy else None,
        policy_name=policy.name if policy else None,
        controller=CONTROLLER_OF_KIND.get(policy.kind, Controller.RL) if policy else None,
        number=said["policy_id"],
        min_ma=said["min_ma"],
        max_ma=said["max_ma"],
        cdbs_ma=said["cdbs_ma"],
    )


def limits_and_policy(recording: Recording) -> Mapping[str, Any] | None:
    """Return the head of a log (`ml.formats.tables.log_head.Ran`); None as in `of_recording`."""
    said = recording.details.get("settings", {}).get("controller")
    return said if isinstance(said, Mapping) else None


class SlotHead(NamedTuple):
    """Present state of one session of a plan: where it is, what it runs, and whether its plan is still signed (`plan_status` approved).

    `sealed`: whether the plan was signed blinded, and its key never opened.
    """

    slot_id: int
    plan_id: int
    plan_status: str
    visit_id: int
    position: int
    controller: str
    policy_id: int | None
    sealed: bool


def slot_head(db: Session, participant_id: int, slot_id: int) -> SlotHead | None:
    """Find a session of one of the participant's plans."""
    item = (PlanItem.id, Plan.id, Plan.status, Plan.visit_id, PlanItem.position, PlanItem.controller, PlanItem.policy_id)
    query = select(*item, SEALED).join_from(PlanItem, Plan, PlanItem.plan_id == Plan.id).join(Visit, Visit.id == Plan.visit_id)
    row = db.execute(query.where(PlanItem.id == slot_id, Visit.participant_id == participant_id)).first()
    return None if row is None else SlotHead(*row)


@dataclass(frozen=True)
class LoggedSlot:
    """The session of a signed plan that a log says it is of.

    Attributes:
        slot_id, plan_id, position, visit_number, visit_date (ISO 8601): at the time when the bundle was made.
        planned: the present session of the plan; None where this participant has none such.
    """

    slot_id: int
    plan_id: int
    position: int
    visit_number: int
    visit_date: str
    planned: SlotHead | None


def slot_of_recording(db: Session, recording: Recording) -> LoggedSlot | None:
    """Return the slot that a recording ran in; None where it is no log, and of trials on a bench and replays, without a participant."""
    said = limits_and_policy(recording)
    if said is None or said.get("purpose") != "session" or said.get("slot_id") is None:
        return None
    head = slot_head(db, recording.participant_id, int(said["slot_id"]))
    # numbers of another installation may be anything: plan, place and slot must belong together
    planned = head if head is not None and (head.plan_id, head.position) == (said["plan_id"], said["position"]) else None
    return LoggedSlot(
        int(said["slot_id"]), int(said["plan_id"]), int(said["position"]), int(said["visit_number"]), str(said["visit_date"]), planned
    )


def policy_share(recording: Recording) -> float | None:
    """Return the share of a session's decisions that followed its policy or schedule; None without a session's log."""
    said = limits_and_policy(recording)
    if said is None or said.get("purpose") != "session" or said.get("policy_share") is None:
        return None
    return float(said["policy_share"])


def rehearsed(recording: Recording) -> bool:
    """Check whether a log is of a trial on a bench: a controller ran, and no participant was connected."""
    said = limits_and_policy(recording)
    return said is not None and said.get("purpose") == "bench"


def simulated(recording: Recording) -> bool:
    """Check whether the device side of a log was a simulation."""
    said = limits_and_policy(recording)
    return said is not None and bool(said.get("simulated"))


def design_of_session(session: StudySession) -> dict[str, Any] | None:
    """Return the design of a random session's amplitudes, by the log of the schedule that ran, as members of its conditions.

    None where no such log is its control recording, or where the session does not begin where the schedule took over.
    """
    control = next((s for s in session.segments if s.is_control), None)
    said = limits_and_policy(control.recording) if control is not None else None
    if control is None or said is None or said.get("design") is None or not said.get("holds") or control.start_s > 1e-3:
        return None
    parameters = {"level": said.get("level"), "holds": said["holds"]}
    known = {"design": said["design"], "seed": said.get("seed"), "design_parameters": parameters}
    return known | ({"lower_bound": said["lower_bound"]} if said.get("lower_bound") is not None else {})
