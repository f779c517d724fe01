"""Values that can be, but seldom are: asked about once, and kept where a person says that they are right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from ml.outcomes import OUTCOMES

SURE = (
    "Values outside the usual that a person has looked at: they are right. Where it is given, an empty list too, other unusual values are"
    " refused with `questions` (422); left out, as by a program that can ask nobody, values are kept as they are."
)


class Why(StrEnum):
    """What is unusual about a value."""

    BELOW = "below_usual"
    ABOVE = "above_usual"
    SHARE = "share_not_percent"
    """Between 0 and 1 where per cent are asked for."""
    FAR_FROM_VISIT = "far_from_visit"
    """Far from every other value of the visit: the scale may have been read the other way round."""


class Usual(NamedTuple):
    """From where to where a value lies as a rule, both included."""

    low: float
    high: float
    unit: str


USUAL = {o.field: Usual(*o.usual, o.entry_unit) for o in OUTCOMES if o.usual is not None} | {"cdbs_amplitude_ma": Usual(0.5, 6.0, "mA")}
"""Chronic stimulation has 1 to 4 mA."""
FAR = {o.field: o.far for o in OUTCOMES if o.far is not None}
"""By how much a value differs from each of `LEAST_OTHERS` others of its visit before it is asked about."""
LEAST_OTHERS = 3


@dataclass(frozen=True)
class Question:
    """A value to look at again.

    Attributes:
        field: of the request. value: what was given, in `unit`. low, high: what is usual.
        hemisphere, program: of an amplitude that a visit states.
        confirmed: whether a person has said that it is right.
    """

    field: str
    code: Why
    value: float
    unit: str
    low: float
    high: float
    hemisphere: str | None = None
    program: int | None = None
    confirmed: bool = False


def question(name: str, value: float | None, others: Sequence[float] = ()) -> Question | None:
    """What to ask about one value; None where it is usual.

    Args:
        name: the field of an outcome, or `cdbs_amplitude_ma`. value: in its unit.
        others: the same value of the visit's other sessions.
    """
    if value is None:
        return None
    if name in FAR:
        far = len(others) >= LEAST_OTHERS and all(abs(value - other) >= FAR[name] for other in others)
        return Question(name, Why.FAR_FROM_VISIT, value, "", min(others), max(others)) if far else None
    low, high, unit = USUAL[name]
    if unit == "%" and 0 < value < 1:
        return Question(name, Why.SHARE, value, unit, low, high)
    if low <= value <= high:
        return None
    return Question(name, Why.BELOW if value < low else Why.ABOVE, value, unit, low, high)
