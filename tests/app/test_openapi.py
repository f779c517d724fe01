"""The REST interface against its recorded description: every change of it is seen in a commit.

After an intended change, record it and name it in CHANGELOG: `.venv/bin/python -m tests.app.test_openapi`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

RECORDED = Path(__file__).resolve().parents[1] / "data" / "openapi.json"


def differences(recorded: Any, served: Any, place: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield the places at which two JSON documents differ, and how."""
    if isinstance(recorded, dict) and isinstance(served, dict):
        for key in sorted(recorded.keys() | served.keys()):
            if key not in served:
                yield f"{' > '.join((*place, key))} is gone"
            elif key not in recorded:
                yield f"{' > '.join((*place, key))} is new"
            else:
                yield from differences(recorded[key], served[key], (*place, key))
    elif isinstance(recorded, list) and isinstance(served, list) and len(recorded) == len(served):
        for i, (a, b) in enumerate(zip(recorded, served, strict=True)):
            yield from differences(a, b, (*place, str(i)))
    elif recorded != served:
        yield f"{' > '.join(place)} was {json.dumps(recorded)}, is {json.dumps(served)}"


def test_the_interface_is_the_recorded_one(service_app: Any) -> None:
    recorded, served = json.loads(RECORDED.read_text()), json.loads(json.dumps(service_app.openapi()))
    lines = "\n".join(f"  {line}" for line in differences(recorded, served))
    assert recorded == served, f"the REST interface has changed; where that is meant, see the head of this file:\n{lines}"


def test_a_difference_of_each_kind_is_seen_at_its_place() -> None:
    recorded, changed = (json.loads(RECORDED.read_text()) for _ in range(2))
    assert list(differences(recorded, changed)) == []
    del changed["paths"]["/api/v1/bundle-key"]
    changed["paths"]["/api/v1/sessions/{session_id}"]["delete"] = {}
    operation = changed["paths"]["/api/v1/participants/{code}"]["get"]
    operation["description"] = "Other words."
    operation["parameters"][0]["required"] = False
    operation["parameters"].append({})
    changed["components"]["schemas"]["QocIn"]["properties"]["rating"]["anyOf"][0]["maximum"] = 5
    changed["components"]["schemas"]["ParticipantIn"]["required"] = []
    found = list(differences(recorded, changed))
    assert [line.partition(" was ")[0] for line in found] == [
        "components > schemas > ParticipantIn > required",
        "components > schemas > QocIn > properties > rating > anyOf > 0 > maximum",
        "paths > /api/v1/bundle-key is gone",
        "paths > /api/v1/participants/{code} > get > description",
        "paths > /api/v1/participants/{code} > get > parameters",
        "paths > /api/v1/sessions/{session_id} > delete is new",
    ]


def schemas(part: Any, place: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every schema of an OpenAPI document, and every schema inside one, with its place."""
    if isinstance(part, list):
        for i, one in enumerate(part):
            yield from schemas(one, f"{place} > {i}")
    if not isinstance(part, dict):
        return
    if {"type", "anyOf", "oneOf", "allOf", "$ref", "enum", "const"} & part.keys() and not place.endswith(" > properties"):
        yield place, part
    for key, value in part.items():
        yield from schemas(value, f"{place} > {key}")


def test_every_bound_is_one_that_readers_of_a_json_schema_know(service_app: Any) -> None:
    found = list(schemas(service_app.openapi()))
    assert sum("minimum" in schema for _, schema in found) > 100
    raw = [f"{place}: {key}" for place, schema in found for key in schema.keys() & {"ge", "gt", "le", "lt", "multiple_of"}]
    assert raw == []
    # none may promise more than the database's own numbers hold
    wide = [
        p for p, s in found if s.get("format") == "int32" and not -(2**31) <= s.get("minimum", 0) <= s.get("maximum", 0) + 2**31 < 2**32
    ]
    assert wide == []


if __name__ == "__main__":
    from app.main import create_app

    RECORDED.write_text(json.dumps(create_app().openapi(), indent=1, sort_keys=True, ensure_ascii=False) + "\n")
