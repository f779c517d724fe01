"""Warnings against a plan, as typed records; their sentences are made in `app.planning.plans.wording`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any


class Code(StrEnum):
    """Kinds of warnings."""

    STALE_RANKING = "stale_ranking"
    RANKING_NOTE = "ranking_note"
    NOT_EVALUATED = "not_evaluated"
    LOWEST_AMPLITUDE = "lowest_amplitude"
    OVERRIDDEN = "overridden"
    NOT_RANKED = "not_ranked"
    NOT_SUPPORTED = "not_supported"
    FLAGS = "flags"
    RETIRED = "retired"
    CANNOT_BE_SIGNED = "cannot_be_signed"
    VISIT_HELD = "visit_held"
    DATE_PAST = "date_past"
    ONE_POLICY = "one_policy"
    MARGINS_NOT_LOCKED = "margins_not_locked"
    KEY_REASON_MISSING = "key_reason_missing"
    ADVERSE_EVENT = "adverse_event"
    """A serious one that no clinician has cleared, and that the plan's reason for its policy does not answer: the plan may not run."""
    OTHER_MEDICATION = "other_medication"
    """The participant's schedule says otherwise now than when the plan was drafted."""


OF_METHODS = (Code.RANKING_NOTE, Code.FLAGS)
"""What is about estimates and the methods that made them; a plan's verdicts say what follows from it."""


@dataclass(frozen=True)
class PlanWarning:
    """One warning.

    Attributes:
        code: its kind, for programs. policy_id, policy: whom it is about; None for the whole plan.
        values: what its sentence is made of.
    """

    code: Code
    policy_id: int | None = None
    policy: str | None = None
    values: Mapping[str, Any] = field(default_factory=dict)


def without_policies(warnings: Sequence[PlanWarning]) -> list[PlanWarning]:
    """Select those that name no policy, for a blinded reader. It is shown that a plan may not run after an adverse event, but not why."""
    told = [w for w in warnings if w.policy_id is None and w.code is not Code.RANKING_NOTE]
    return told + [PlanWarning(Code.ADVERSE_EVENT)] * any(w.code is Code.ADVERSE_EVENT for w in warnings)
