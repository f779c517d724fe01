"""Words of what is asked about unusual values."""

from __future__ import annotations

from app.platform.web.numbers import stated
from app.study.usual.values import Question, Why
from ml.outcomes import BY_FIELD

UNUSUAL = "Some values are unusual: are they right?"
UNUSUAL_HINT = "Correct them, or say that they are right; nothing was saved yet."


def unusual(asked: Question) -> str:
    """What is asked about one value."""
    value = f"{stated(asked.value, 4)} {asked.unit}".strip()
    usual = f"{asked.low:g} to {asked.high:g} {asked.unit}".strip()
    match asked.code:
        case Why.SHARE:
            return f"{value}: less than one per cent. Was it meant as a share, {stated(100 * asked.value, 3)} %?"
        case Why.FAR_FROM_VISIT:
            return f"{value}, where the other sessions of this visit have {usual}: {_ends(asked.field)}. Is it right?"
        case Why.BELOW:
            return f"{value} is below what is usual ({usual}). Is it right?"
        case Why.ABOVE:
            return f"{value} is above what is usual ({usual}). Is it right?"


def _ends(field: str) -> str:
    """Which end of an outcome's scale is the worst, and which the best."""
    outcome = BY_FIELD[field]
    best = outcome.high if outcome.higher_is_better else outcome.low
    return f"{outcome.worst_possible:g} is worst, {best:g} is best"
