"""The kinds of jobs that betaloop has, one record each. API, form, pages and workers derive from them; nothing heavy is imported here."""

from __future__ import annotations

from sqlalchemy.orm import Session

from app.evaluation.estimates.service import policies_to_rank
from app.evaluation.schemas import EvaluateParams
from app.learning.schemas import DistilParams, TrainParams
from app.learning.snapshots import collect
from app.pipeline.distillation import teachers
from app.pipeline.next_generation import policies_that_ran
from app.pipeline.params import (
    NEXT_GENERATION,
    THRESHOLD_RULE,
    NextGenerationParams,
    PipelineParams,
    ThresholdRuleParams,
    rule_within_reach,
)
from app.pipeline.training import training_starts
from app.platform.errors import Invalid
from app.platform.jobs import JobKind, Priority, register
from app.tables.participants import Participant

_TRAINING = {"train": "app.learning.training_compute:train", "baselines": "app.learning.training_compute:baselines"}
_DISTILLATION = {"distil": "app.learning.training_compute:distil"}
_EVALUATION = {
    "fit_dlsm": "app.evaluation.estimates.compute:fit_dlsm",
    "check_coverage": "app.evaluation.estimates.compute:check_coverage",
    "evaluate_method": "app.evaluation.estimates.compute:evaluate_method",
    "choose_method": "app.evaluation.estimates.compute:choose_method",
}


def usable_sessions(db: Session, participant_id: int, params: object) -> None:
    """Raise Invalid where the participant has no threshold of beta yet, or no session that could enter a snapshot."""
    collect(db, db.get_one(Participant, participant_id))


def starts_of_the_training(db: Session, participant_id: int, params: PipelineParams) -> None:
    """Raise where a policy to fine-tune from is not there, or cannot be trained further."""
    training_starts(db, participant_id, params.training())


def something_tested(db: Session, participant_id: int, params: object) -> None:
    """Raise where no policy that could be trained further has run in a session."""
    participant = db.get_one(Participant, participant_id)
    ran = policies_that_ran(db, participant)
    if ran and all(t.obstacle for t in ran):
        raise Invalid(
            f"No policy of participant {participant.code} that ran in a session can be trained further: "
            + " ".join(f"'{t.policy.name}': {t.obstacle}" for t in ran),
            "Clear what blocks one of them, or start a job of kind 'pipeline'.",
        )
    if not ran:
        raise Invalid(
            f"No policy of participant {participant.code} that could be trained further has been tested in a session yet.",
            "Confirm the sessions of the visit first; before the first visit with policies start a job of kind 'pipeline'.",
        )


register(
    JobKind(
        name="pipeline",
        title="Between-visit pipeline",
        params=PipelineParams,
        orchestration="app.pipeline.between_visits:run_pipeline",
        compute=_TRAINING | _DISTILLATION | _EVALUATION,
        requires=(usable_sessions, starts_of_the_training),
    )
)
register(
    JobKind(
        name=NEXT_GENERATION,
        title="Next generation from what did best",
        params=NextGenerationParams,
        orchestration="app.pipeline.next_generation_job:run_next_generation",
        compute=_TRAINING | _DISTILLATION | _EVALUATION,
        requires=(usable_sessions, something_tested),
        priority=Priority.INTERACTIVE,
        one_at_a_time=True,
    )
)
register(
    JobKind(
        name="evaluate",
        title="Evaluate and rank policies",
        params=EvaluateParams,
        orchestration="app.pipeline.evaluation:run_evaluate",
        compute=_EVALUATION,
        requires=(usable_sessions, policies_to_rank),
        priority=Priority.INTERACTIVE,
    )
)
register(
    JobKind(
        name="train",
        title="Train policies",
        params=TrainParams,
        orchestration="app.pipeline.training:run_train",
        compute=_TRAINING,
        requires=(usable_sessions, training_starts),
        priority=Priority.BATCH,
    )
)
register(
    JobKind(
        name="distill",
        title="Distil policies",
        params=DistilParams,
        orchestration="app.pipeline.distillation:run_distil",
        compute=_DISTILLATION,
        requires=(usable_sessions, teachers),
    )
)
register(
    JobKind(
        name=THRESHOLD_RULE,
        title="Closest settings of an implant on the market",
        params=ThresholdRuleParams,
        orchestration="app.pipeline.evaluation:run_threshold_rule",
        compute={"find_rule": "app.evaluation.estimates.compute:find_rule"},
        requires=(usable_sessions, rule_within_reach),
        priority=Priority.INTERACTIVE,
    )
)
