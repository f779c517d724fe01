"""Methods of evaluation as the API takes them: their keys, and which of them a preset runs. `ml.ope.registry` has the methods."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

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


def quick_methods() -> list[str]:
    """What the preset `quick` runs where nothing is said, so that a first ranking takes minutes."""
    return [m.key for m in registry.methods() if m.quick]


def methods_of(preset: str) -> list[str]:
    """What a preset runs where no methods are named."""
    return quick_methods() if preset == "quick" else [m.key for m in registry.methods() if not m.on_request]


def names() -> dict[str, str]:
    """What pages call the methods, by key."""
    return {m.key: m.name for m in registry.methods()}


def _checked(methods: list[str]) -> list[str]:
    once = list(dict.fromkeys(methods))
    if AGGREGATE in once and len(once) < 3:
        raise ValueError("the combination needs the estimates of at least two other methods: name them too")
    return once


def _of_preset(values: Mapping[str, Any]) -> list[str]:
    return methods_of(str(values.get("preset", "full")))


_ON_REQUEST = [m.key for m in registry.methods() if m.on_request]

Methods = Annotated[
    list[Method],
    Field(
        default_factory=_of_preset,
        min_length=1,
        max_length=20,
        description=f"Estimators to run; where not given, for `full` all but {', '.join(_ON_REQUEST)}"
        f" and for `quick` {', '.join(quick_methods())}.",
    ),
    AfterValidator(_checked),
]
