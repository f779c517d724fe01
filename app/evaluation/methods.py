"""Methods of evaluation as the API takes them: their keys, and which of them run by default. `ml.ope.registry` has the methods."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ml.ope import AGGREGATE, registry


class _PublishedKeys:
    """The keys of all methods as the enumeration of the JSON schema."""

    def __get_pydantic_json_schema__(self, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {**handler(core_schema), "enum": list(registry.method_keys())}


def _known(key: str) -> str:
    if key not in registry.method_keys():
        raise ValueError(f"'{key}' is no method of evaluation; choose among {', '.join(registry.method_keys())}")
    return key


Method = Annotated[str, AfterValidator(_known), _PublishedKeys()]


def default_methods() -> list[str]:
    """List the methods that run where none are named: those that the answer rests on, so that it is there within seconds."""
    return [m.key for m in registry.methods() if m.by_default]


def names() -> dict[str, str]:
    """Return the names of the methods on pages, by key."""
    return {m.key: m.name for m in registry.methods()}


def _checked(methods: list[str]) -> list[str]:
    once = list(dict.fromkeys(methods))
    if AGGREGATE in once and len(once) < 3:
        raise ValueError("the combination needs the estimates of at least two other methods: name them too")
    return once


Methods = Annotated[
    list[Method],
    Field(
        default_factory=default_methods,
        min_length=1,
        max_length=20,
        description=f"Estimators to run; where not given, those that the answer rests on: {', '.join(default_methods())}.",
    ),
    AfterValidator(_checked),
]
