"""From estimates and their flags to the types of the API."""

from __future__ import annotations

from typing import TypeVar

from app.evaluation import wording
from app.evaluation.schemas import EstimateSummary, FlagOut, ReasonOut
from ml.ope import Estimate, Flag

Shown = TypeVar("Shown", bound=EstimateSummary)


def flag_out(flag: Flag) -> FlagOut:
    """A flag with its sentence."""
    return FlagOut(code=flag.code, value=flag.value, limit=flag.limit, unit=flag.unit, text=wording.sentence(flag))


def reason_out(flag: Flag) -> ReasonOut:
    """A flag as values alone."""
    return ReasonOut(code=flag.code, value=flag.value, limit=flag.limit, unit=flag.unit)


def estimate_out(estimate: Estimate, shape: type[Shown]) -> Shown:
    """An estimate in one of the shapes of the API: each of its fields is the estimate's of the same name."""
    values = {name: getattr(estimate, name) for name in shape.model_fields}
    return shape.model_validate(values | {"flags": [flag_out(flag) for flag in estimate.flags]})
