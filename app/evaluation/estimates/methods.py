"""The estimators that jobs run, by the keys of `ml.ope.registry`: what pages call them, and which of them a preset runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

AGGREGATE = "aggregate"
"""The combination of the others: not fitted, but computed from their estimates."""

Method = Literal["dlsm", "linear", "dlmm", "fqe", "wdr", "dual_dice", "wis", "pdis", "cwpdis", "aggregate"]
METHODS: tuple[Method, ...] = ("dlsm", "linear", "dlmm", "fqe", "wdr", "dual_dice", "wis", "pdis", "cwpdis", "aggregate")
QUICK_METHODS: tuple[Method, ...] = ("dlsm", "linear", "fqe", "wdr", "wis", "pdis", "aggregate")
"""What the preset `quick` runs where nothing is said: one method of every family, so that a first ranking takes minutes."""

METHOD_NAMES: dict[str, str] = {
    "dlsm": "DLSM",
    "linear": "Linear model",
    "dlmm": "DLMM",
    "fqe": "Fitted Q evaluation",
    "wdr": "Weighted doubly robust",
    "dual_dice": "DualDICE",
    "wis": "Weighted importance sampling",
    "pdis": "Per-decision importance sampling",
    "cwpdis": "Consistent weighted per-decision importance sampling",
    "aggregate": "Combination of all methods",
}
METHOD_SHORT: dict[str, str] = METHOD_NAMES | {
    "linear": "Linear",
    "fqe": "FQE",
    "wdr": "WDR",
    "wis": "WIS",
    "pdis": "PDIS",
    "cwpdis": "CWPDIS",
    "aggregate": "Combination",
}
"""For the heads of wide tables."""

METHOD_WEIGHTS: dict[Method, float] = {
    "dlsm": 6.0, "linear": 2.0, "dlmm": 3.0, "fqe": 1.0, "wdr": 2.0, "dual_dice": 3.0, "wis": 1.0, "pdis": 1.0, "cwpdis": 1.0
}  # fmt: skip
"""Share of a job's progress that one method's step takes."""


def methods_of(preset: str) -> list[Method]:
    """What a preset runs where no methods are named."""
    return list(QUICK_METHODS if preset == "quick" else METHODS)


def _checked(methods: list[Method]) -> list[Method]:
    once = list(dict.fromkeys(methods))
    if AGGREGATE in once and len(once) < 3:
        raise ValueError("the combination needs the estimates of at least two other methods: name them too")
    return once


def _of_preset(values: Mapping[str, Any]) -> list[Method]:
    return methods_of(str(values.get("preset", "full")))


Methods = Annotated[
    list[Method],
    Field(
        default_factory=_of_preset,
        min_length=1,
        max_length=20,
        description=f"Estimators to run; where not given, all for `full` and for `quick` {', '.join(QUICK_METHODS)}.",
    ),
    AfterValidator(_checked),
]
