"""Estimates between the science's own type and their stored rows. A row has columns for what queries need; the rest is in `details`."""

from __future__ import annotations

from app.tables.evaluations import EstimateRow
from ml.ope import Estimate

_COLUMNS = {column.key for column in EstimateRow.__table__.columns}


def row_of(policy_id: int, estimate: Estimate) -> EstimateRow:
    """An estimate as it is stored."""
    stored = estimate.to_json()
    details = stored.pop("details") | {name: stored.pop(name) for name in list(stored) if name not in _COLUMNS}
    # an interval of a skewed bootstrap may miss the estimate itself; the table keeps it inside
    ends = {"low": min(estimate.low, estimate.value), "high": max(estimate.high, estimate.value)}
    predicted = {name: v for name, v in estimate.predicted.items() if v is not None}
    return EstimateRow(policy_id=policy_id, **stored | ends | {"predicted": predicted, "details": details})


def estimate_of(row: EstimateRow) -> Estimate:
    """A stored estimate of any version."""
    details = dict(row.details)
    apart = {name: details.pop(name) for name in ("step_return", "end_reward", "n", "version") if name in details}
    stored = {name: getattr(row, name) for name in _COLUMNS} | apart | {"details": details}
    return Estimate.from_json(stored | {"standard_error": row.standard_error or 0.0})
