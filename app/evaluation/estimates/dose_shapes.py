"""Dose shapes of outcomes: what each participant's own data say of them, stored with every evaluation, and what is pooled of it.

Another participant's evaluation takes the stored evidences and none of the data behind them (`ml.ope.outcomes.pooling`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from sqlalchemy.orm import Session

from app.evaluation import repository
from app.tables.evaluations import Evaluation
from app.tables.participants import Participant, SettingsVersion
from ml.ope.outcomes.minutes import SHAPES

if TYPE_CHECKING:
    from ml.ope import FittedPosterior

STORED = "dose_shapes"
"""Member of an evaluation's diagnostics, and of what the posterior's compute step gives."""

KNOWN = [list(shape) for shape in SHAPES]
"""The shapes as JSON has them: evidences of other ones, of another version, are not compared with these."""


def found(fitted: FittedPosterior) -> dict[str, Any]:
    """Return the evidence of a fit on dose shapes, JSON-able.

    Returns:
        `shapes`; `evidence`, by outcome the log evidence of each by these data alone; `pooling`, by outcome what came of pooling them,
        empty where other participants were not asked.
    """
    evidence = {outcome: [round(float(v), 4) for v in each] for outcome, each in fitted.ends.shape_evidence.items()}
    return {"shapes": KNOWN, "evidence": evidence, "pooling": fitted.shape_pooling}


def of_others(db: Session, participant: Participant, settings: SettingsVersion) -> dict[str, Any] | None:
    """Return the dose shapes in the newest evaluations of the site's other participants; None where the settings do not ask for them.

    Withdrawn participants are excluded, and those of another site: those who read this participant's results may not read theirs. Sessions
    under a sealed key are in no evaluation.

    Returns:
        `evidence` of each of them by outcome, and `evaluations`, their numbers.
    """
    if not settings.pool_shapes:
        return None
    stored = repository.diagnostics_of_others(db, participant, STORED)
    usable = {number: one["evidence"] for number, one in stored.items() if one.get("shapes") == KNOWN}
    return {"evidence": list(usable.values()), "evaluations": list(usable)}


def pooling(evaluation: Evaluation) -> Mapping[str, Mapping[str, Any]]:
    """Return by outcome the result of pooling its dose shapes in an evaluation (`Proof.to_json`); empty where others were not used."""
    found: Mapping[str, Mapping[str, Any]] = (evaluation.diagnostics.get(STORED) or {}).get("pooling") or {}
    return found
