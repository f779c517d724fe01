"""Where the REST interface differs from the released one in many places alike: each place, and the sentence of CHANGELOG that says it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

_RELEASED = json.loads((Path(__file__).resolve().parent / "data" / "openapi-0.1.0.json").read_text())
_BOUNDED = {
    "DistillJob": ("hidden", "policies", "updates"),
    "EvaluateJob": ("horizon_steps", "policies"),
    "PipelineJob": ("distil_updates", "horizon_steps", "policies", "updates"),
    "PlanIn": ("evaluation_id", "policy_ids", "seed"),
    "QocIn": ("rating",),
    "TrainJob": ("batch", "policies", "updates"),
}
"""Fields of the release that published the bounds of whole numbers as `ge` and `le`."""


def _answers() -> Iterator[str]:
    """Places of the answers that stand before every route."""
    for path, operations in _RELEASED["paths"].items():
        for method, operation in operations.items():
            statuses = {"503"} | ({"507"} if "security" in operation else set())
            statuses |= {"413", "429"} if method != "get" else set()
            statuses |= {"400"} if "requestBody" in operation else set()
            for status in statuses - operation["responses"].keys():
                yield f"paths > {path} > {method} > responses > {status}"


EVERYWHERE: dict[str, str] = {
    **dict.fromkeys(
        (f"components > schemas > {schema} > properties > {field}" for schema, fields in _BOUNDED.items() for field in fields),
        "API: bounds of whole numbers beside null and in lists are published as `minimum` and `maximum`",
    ),
    **dict.fromkeys(_answers(), "API: answers that stand before every route are documented (400, 413, 429, 503, 507)"),
}
