"""Estimates between their stored rows, JSON and the science's own type."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from app.evaluation.models import EstimateRow
from ml.ope.estimate import Estimate


def as_estimate(values: Mapping[str, Any]) -> Estimate:
    """The inverse of `Estimate.to_json`."""
    return Estimate(**{**values, "flags": tuple(values["flags"])})


def estimate_of(row: EstimateRow) -> Estimate:
    """A stored estimate as the science knows it."""
    details = dict(row.details)
    return Estimate(
        method=row.method,
        value=row.value,
        low=row.low,
        high=row.high,
        level=row.level,
        standard_error=row.standard_error or 0.0,
        step_return=details.pop("step_return"),
        end_reward=details.pop("end_reward"),
        predicted={name: float(v) for name, v in row.predicted.items()},
        supported=row.supported,
        flags=tuple(row.flags),
        n=details.pop("n"),
        details=details,
    )
