"""Columns and fields of the interface, one per outcome, made from the records of `ml.outcomes`; questions about unusual values."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from pydantic import Field, create_model, model_validator

from app.platform.errors import Invalid
from app.platform.numbers import stated
from app.platform.web.schemas import Int, Model, Number
from ml.outcomes import BY_FIELD, OUTCOMES
from ml.outcomes.records import Outcome

if TYPE_CHECKING:
    OutcomeField = str
    DerivedField = str
else:
    OutcomeField = Literal[tuple(o.field for o in OUTCOMES)]
    DerivedField = Literal[tuple(o.field for o in OUTCOMES if o.derived)]


class _WholeValues(Model):
    """Outcomes that are whole numbers may be written with decimals that say nothing, as spreadsheets write them: 8.0."""

    @model_validator(mode="before")
    @classmethod
    def _without_decimals(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        whole = {o.field: values.get(o.field) for o in OUTCOMES if o.whole}
        return values | {field: int(v) for field, v in whole.items() if isinstance(v, float) and v.is_integer()}


def fields_model(name: str, field_of: Callable[[Outcome], Mapping[str, Any]], base: type[Model] = Model) -> type[Model]:
    """Return an API type with the fields of `base`, then those that `field_of` gives for each outcome, as (type, field) by name."""
    fields = {field: made for o in OUTCOMES for field, made in field_of(o).items()}
    return create_model(name, __base__=base, __module__=__name__, **fields)


def _entered(o: Outcome) -> Mapping[str, Any]:
    ends: dict[str, Any] = {"lt": o.below} if o.below is not None else {"le": o.high}
    kind = Int if o.whole else Number
    return {o.field: (kind | None, Field(None, ge=o.low, **ends, description=o.description))}


def _stored(o: Outcome) -> Mapping[str, Any]:
    return {o.field: ((int if o.whole else float) | None, ...)}


def _stated_margin(o: Outcome) -> Mapping[str, Any]:
    return {o.margin.field: (Number, Field(o.margin.default, description=o.margin.description))}


if TYPE_CHECKING:

    class EnteredOutcomes(Model):
        """A field per outcome: its value, or null to take it back."""

    class StoredOutcomes(Model):
        """A field per outcome: its value, null where not measured."""

    class StatedMargins(Model):
        """A field per margin, the default where omitted."""

    class VersionOfMargins(Model):
        """A version of margins: its number, and a field per margin."""

        version: int

else:
    EnteredOutcomes = fields_model("EnteredOutcomes", _entered, _WholeValues)
    StoredOutcomes = fields_model("StoredOutcomes", _stored)
    StatedMargins = fields_model("StatedMargins", _stated_margin)
    _Version = create_model("_Version", __base__=Model, version=(int, ...))
    VersionOfMargins = fields_model("VersionOfMargins", lambda o: {o.margin.field: (float, ...)}, _Version)


# Values that can be, but seldom are: asked about once, and kept where a person says that they are right.

SURE = (
    "Values outside the usual that a person has looked at: they are right. Where it is given, an empty list too, other unusual values are"
    " refused with `questions` (422); left out, as by a program that can ask nobody, values are kept as they are."
)


class Why(StrEnum):
    """Reason why a value is unusual."""

    BELOW = "below_usual"
    ABOVE = "above_usual"
    SHARE = "share_not_percent"
    """Between 0 and 1 where per cent are asked for."""
    FAR_FROM_VISIT = "far_from_visit"
    """Far from every other value of the visit: the scale may have been read the other way round."""


class Usual(NamedTuple):
    """Range in which a value usually is, both ends included."""

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
        confirmed: whether a person has confirmed it.
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
    """Return the question about one value; None where it is usual.

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


# Words of what is asked about unusual values.

UNUSUAL = "Some values are unusual: are they right?"
UNUSUAL_HINT = "Correct them, or say that they are right; nothing was saved yet."


def unusual(asked: Question) -> str:
    """Write the question about one value."""
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
    """Describe which end of an outcome's scale is the worst, and which the best."""
    outcome = BY_FIELD[field]
    best = outcome.high if outcome.higher_is_better else outcome.low
    return f"{outcome.worst_possible:g} is worst, {best:g} is best"


class Unusual(Invalid):
    """Values that a person has to confirm; `questions` has them."""

    def __init__(self, questions: Sequence[Question]) -> None:
        super().__init__(UNUSUAL, UNUSUAL_HINT, questions=[_told(q) for q in questions])
        self.questions = tuple(questions)


def require_sure(
    given: Mapping[str, Any], sure: Collection[str] | None, known: object = None, others: Mapping[str, Sequence[float]] | None = None
) -> None:
    """Raise Unusual for values outside the usual that are not confirmed; stored ones are not questioned again.

    Args:
        given: name to value. known: the row with the present values.
        sure: names that a person has confirmed; None where no person can be asked, as of a program's call: nothing is asked then.
        others: by name, values of the visit's other sessions.
    """
    if sure is None:
        return
    asked = [
        question(name, value, (others or {}).get(name, ()))
        for name, value in given.items()
        if (name in USUAL or name in FAR) and value != getattr(known, name, None)
    ]
    refuse(replace(q, confirmed=q.field in sure) for q in asked if q is not None)


def refuse(asked: Iterable[Question]) -> None:
    """Raise Unusual with all questions where one is not confirmed, so that an answer to one is not lost while another is open."""
    found = list(asked)
    if not all(q.confirmed for q in found):
        raise Unusual(found)


def _told(asked: Question) -> dict[str, Any]:
    return {k: v for k, v in asdict(asked).items() if v is not None} | {"text": unusual(asked)}
