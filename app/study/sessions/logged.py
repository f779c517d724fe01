"""What the log of a controller says of its session: which policy decided, and within which limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy.orm import Session

from app.study import repository
from app.study.models import Controller, Recording

CONTROLLER_OF_KIND = {"distilled": Controller.DISTILLED, "baseline": Controller.OTHER}
"""Controllers of policies by their kind; those of every other kind are RL."""


@dataclass(frozen=True)
class Logged:
    """What ran, by the controller's own log.

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
    """What a recording says of its controller; None where it is no log, or a log that does not tell."""
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
    """What stands at the head of a log (`ml.formats.tables.log_head.Ran`); None as in `of_recording`."""
    said = recording.details.get("settings", {}).get("controller")
    return said if isinstance(said, Mapping) else None
