"""Columns of tables and fields of the interface, one per outcome, made from the records of `ml.outcomes`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, create_model, model_validator

from app.platform.web.schemas import Int, Model, Number
from ml.outcomes import OUTCOMES, Outcome

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
        """A field per margin, the default where left out."""

    class VersionOfMargins(Model):
        """A version of margins: its number, and a field per margin."""

        version: int

else:
    EnteredOutcomes = fields_model("EnteredOutcomes", _entered, _WholeValues)
    StoredOutcomes = fields_model("StoredOutcomes", _stored)
    StatedMargins = fields_model("StatedMargins", _stated_margin)
    _Version = create_model("_Version", __base__=Model, version=(int, ...))
    VersionOfMargins = fields_model("VersionOfMargins", lambda o: {o.margin.field: (float, ...)}, _Version)
