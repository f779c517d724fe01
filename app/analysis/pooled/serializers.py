"""Results of all participants as API types."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from app.analysis import wording
from app.analysis.pooled.schemas import (
    OfParticipantOut,
    ParticipantVerdictsOut,
    PooledMetricOut,
    PooledOut,
    StepTimeOut,
    SummaryOut,
    TimeTestedOut,
)
from app.analysis.pooled.service import Pooled, StepTime
from app.analysis.primary.serializers import average_out, verdict_out
from app.analysis.trial_time.service import TrialTime
from ml.statistics.pooling import Summary
from ml.statistics.within_visits.contrasts import Unavailable

Table = tuple[Sequence[str], Sequence[Sequence[object]]]
"""Columns and rows."""


def pooled_out(found: Pooled, times: Sequence[StepTime]) -> PooledOut:
    """Everything of the page."""
    return PooledOut(
        verdicts=[
            ParticipantVerdictsOut(participant=p.evidence.participant, verdicts=[verdict_out(v) for v in p.verdicts])
            for p in found.participants
        ],
        metrics=[
            PooledMetricOut(
                controller=c.controller,
                metric=m.metric,
                each=[OfParticipantOut(participant=code, result=average_out(a)) for code, a in m.each],
                together=_summary(m.summary),
            )
            for c in found.controllers
            for m in c.metrics
        ],
        trial_time=[
            TimeTestedOut(participant=row.participant, controller=t.controller, sessions=t.sessions, minutes=t.minutes)
            for row in found.trial.rows
            for t in row.tested
        ],
        computation_time=[StepTimeOut(**asdict(t)) for t in times],
    )


def trial_table(found: TrialTime) -> Table:
    """Columns and rows of the trial time, one row per participant and controller."""
    rows = [(row.participant, t.controller.value, t.sessions, t.minutes) for row in found.rows for t in row.tested]
    return tuple(TimeTestedOut.model_fields), rows


def computation_table(times: Sequence[StepTime]) -> Table:
    """Columns and rows of the computation time, one row per job and step."""
    columns = tuple(StepTimeOut.model_fields)
    return columns, [tuple(asdict(t)[name] for name in columns) for t in times]


def _summary(found: Summary | Unavailable) -> SummaryOut:
    if isinstance(found, Unavailable):
        empty = dict.fromkeys(("estimate", "low", "high", "between_sd", "predicted_low", "predicted_high", "smallest_sign_p"))
        return SummaryOut.model_validate({**empty, "participants": found.found, "text": wording.not_pooled(found)})
    names = ("estimate", "low", "high", "between_sd", "predicted_low", "predicted_high", "participants", "smallest_sign_p")
    return SummaryOut.model_validate({n: getattr(found, n) for n in names} | {"text": wording.no_population_claim(found)})
