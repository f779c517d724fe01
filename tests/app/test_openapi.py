"""The REST interface against the one that was released: every difference is intended, and CHANGELOG names it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.app.openapi_differences import INTENDED

ROOT = Path(__file__).resolve().parents[2]
RELEASED = ROOT / "tests" / "data" / "openapi-0.1.0.json"


def differences(old: Any, new: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """(place, what) of every difference; the words of descriptions are no part of the contract."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted(old.keys() | new.keys()):
            if key in ("description", "summary") and isinstance(old.get(key, new.get(key)), str):
                continue
            if key not in new:
                yield " > ".join((*place, key)), "is gone"
            elif key not in old:
                yield " > ".join((*place, key)), "is new"
            else:
                yield from differences(old[key], new[key], (*place, key))
    elif isinstance(old, list) and isinstance(new, list) and all(isinstance(v, dict) and "name" in v for v in old + new):
        # parameters: their order says nothing
        yield from differences({f"{v['in']} {v['name']}": v for v in old}, {f"{v['in']} {v['name']}": v for v in new}, place)
    elif isinstance(old, list) and isinstance(new, list) and any(isinstance(v, dict) for v in old + new) and len(old) == len(new):
        # alternatives: their order says nothing either
        for i, (a, b) in enumerate(zip(*(sorted(v, key=lambda one: json.dumps(one, sort_keys=True)) for v in (old, new)), strict=True)):
            yield from differences(a, b, (*place, str(i)))
    elif sorted(old, key=repr) != sorted(new, key=repr) if isinstance(old, list) and isinstance(new, list) else old != new:
        yield " > ".join(place), f"was {json.dumps(old)}, is {json.dumps(new)}"


def compared(old: dict[str, Any], new: dict[str, Any]) -> dict[str, str]:
    """Differences of two documents by place; the version of the service is allowed to move."""
    return dict(differences({k: v for k, v in old.items() if k != "info"}, {k: v for k, v in new.items() if k != "info"}))


def covers(beginning: str, place: str) -> bool:
    """Whether a line of the table is about a place."""
    return place == beginning or place.startswith(f"{beginning} > ")


def test_the_interface_is_the_released_one_but_for_what_is_intended(service_app: Any) -> None:
    found = compared(json.loads(RELEASED.read_text()), service_app.openapi())
    surprising = {place: what for place, what in found.items() if not any(covers(known, place) for known in INTENDED)}
    lines = "\n".join(f"  {place}: {what}" for place, what in surprising.items())
    assert not surprising, f"the REST interface has changed (list what is intended in INTENDED and in CHANGELOG.md):\n{lines}"
    stale = [known for known in INTENDED if not any(covers(known, place) for place in found)]
    assert stale == [], "these stand in INTENDED and do not differ"


def test_every_intended_difference_is_named_in_the_changelog() -> None:
    changelog = " ".join((ROOT / "CHANGELOG.md").read_text().split())
    assert [reason for reason in INTENDED.values() if not reason or " ".join(reason.split()) not in changelog] == []


def test_a_difference_of_each_kind_is_seen_at_its_place() -> None:
    released = json.loads(RELEASED.read_text())
    changed = json.loads(RELEASED.read_text())
    assert compared(released, changed) == {}
    del changed["paths"]["/api/v1/bundle-key"]
    changed["paths"]["/api/v1/sessions/{session_id}"]["delete"] = {}
    operation = changed["paths"]["/api/v1/participants/{code}"]["get"]
    operation["description"] = "Other words."
    operation["parameters"][0]["required"] = False
    operation["responses"]["200"]["content"]["application/json"]["schema"]["$ref"] = "#/components/schemas/Other"
    fields = changed["components"]["schemas"]["QocIn"]["properties"]
    fields["rating"]["anyOf"][0]["maximum"] = 5
    changed["components"]["schemas"]["ParticipantIn"]["required"] = []
    assert set(compared(released, changed)) == {
        "paths > /api/v1/bundle-key",
        "paths > /api/v1/sessions/{session_id} > delete",
        "paths > /api/v1/participants/{code} > get > parameters > path code > required",
        "paths > /api/v1/participants/{code} > get > responses > 200 > content > application/json > schema > $ref",
        "components > schemas > QocIn > properties > rating > anyOf > 0 > maximum",
        "components > schemas > ParticipantIn > required",
    }


def schemas(part: Any, place: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every schema of an OpenAPI document, and every schema inside one, with its place."""
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
