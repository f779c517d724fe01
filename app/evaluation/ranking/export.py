"""The ranking as a table for other programs: every column that the page and the REST interface have."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from fastapi import Response

from app.evaluation.estimates.coverage import CHECKS
from app.evaluation.schemas import FlagOut, RankedPolicy, RankingOut, TestedBefore
from app.platform.web.csv_files import download, safe_cell
from ml.outcomes import FIELDS

_PREDICTED = ("energy", "mean_amplitude", "mean_beta", *FIELDS)
_NUMBERS = ("value", "low", "high", "level", "standard_error", "n", "step_return", "end_reward")
_OF_RANKING = ("participant", "evaluation_id", "created_at", "default_method", "horizon_steps", "gamma", "stale")
_OF_POLICY = (
    "rank",
    "policy_id",
    "name",
    "kind",
    "algorithm",
    "reference",
    "retired",
    "decision",
    "decision_reason",
    "standing",
    "probability_best",
)
_GAIN = ("value", "low", "high")
_TESTED = tuple(TestedBefore.model_fields)
_COVERAGE = tuple(CHECKS)


def to_csv(ranking: RankingOut) -> str:
    """One row per policy and method. Rank, decision, gain over cDBS and probability of being best are by the default method, coverage is of
    the policy whatever the method; `supported` and what follows are of the row's own method.
    """
    sink = io.StringIO()
    out = csv.writer(sink, lineterminator="\n")
    own = ["method", "supported", *_NUMBERS, *_PREDICTED, "flags"]
    whole = [*_OF_RANKING, "snapshot_id", "settings_version", "beta_unit"]
    out.writerow([*whole, *_OF_POLICY, *(f"gain_{n}" for n in _GAIN), *_coverage_columns(), *own, *(f"tested_{n}" for n in _TESTED)])
    for p in (*ranking.policies, *ranking.references):
        of_ranking = [getattr(ranking, n) for n in _OF_RANKING]
        of_ranking += [ranking.snapshot.id, ranking.snapshot.settings_version, ranking.snapshot.beta_unit]
        of_policy = [getattr(p, n) for n in _OF_POLICY] + [getattr(p.gain, n) if p.gain else None for n in _GAIN]
        of_policy += _coverage(p)
        results = [getattr(p.tested, n) if p.tested else (0 if n.startswith("sessions") else None) for n in _TESTED]
        for method, e in p.estimates.items():
            numbers = [method, e.supported, *(getattr(e, n) for n in _NUMBERS), *(e.predicted.get(n) for n in _PREDICTED)]
            out.writerow([safe_cell(cell) for cell in (*of_ranking, *of_policy, *numbers, _texts(e.flags), *results)])
    return sink.getvalue()


def _texts(flags: Sequence[FlagOut]) -> str:
    return "; ".join(flag.text for flag in flags)


def _coverage_columns() -> list[str]:
    return [*(f"coverage_{n}" for n in ("supported", "failing", "notes")), *(f"coverage_{n}" for n in _COVERAGE)]


def _coverage(p: RankedPolicy) -> list[object]:
    """The checks of a policy; empty cells where they were not made."""
    if p.coverage is None:
        return [None] * len(_coverage_columns())
    values = {c.name: c.value for c in p.coverage.checks}
    return [p.coverage.supported, _texts(p.coverage.failing), _texts(p.coverage.notes), *(values.get(n) for n in _COVERAGE)]


def csv_of(found: RankingOut) -> Response:
    """A ranking as a CSV download."""
    return download(to_csv(found), f"{found.participant}-ranking-{found.evaluation_id}.csv")
