"""The calibration as a table for other programs."""

from __future__ import annotations

import csv
import io

from app.analysis.calibration.schemas import CalibrationOut
from app.evaluation.ranking.actual import QUANTITIES
from app.platform.web.csv_files import safe_cell

_OF_POLICY_AT_VISIT = (
    "visit", "visit_date", "evaluation_id", "evaluated_at", "policy_id", "name", "kind", "reference", "horizon_steps", "gamma"
)  # fmt: skip


_OF_PREDICTION = ("method", "supported", "parts", "predicted", "low", "high", "level", "actual", "actual_low", "actual_high", "sessions")


def calibration_to_csv(found: CalibrationOut) -> str:
    """One row per visit, policy and method: what had been predicted, and what the sessions brought."""
    sink = io.StringIO()
    out = csv.writer(sink, lineterminator="\n")
    shown = [f"{name}_{part}" for name in QUANTITIES for part in ("predicted", "actual")]
    out.writerow(["participant", *_OF_POLICY_AT_VISIT, *_OF_PREDICTION, "session_returns", "beta_unit", *shown])
    for p in found.policies:
        whole = [found.participant, *(getattr(p, n) for n in _OF_POLICY_AT_VISIT)]
        for q in p.predictions:
            returns = " ".join(f"{value:.6g}" for value in q.session_returns)
            known = {v.name: (v.predicted, v.actual) for v in q.quantities}
            values = [value for name in QUANTITIES for value in known.get(name, (None, None))]
            cells = (*whole, *(getattr(q, n) for n in _OF_PREDICTION), returns, found.beta_unit, *values)
            out.writerow([safe_cell(cell) for cell in cells])
    return sink.getvalue()
