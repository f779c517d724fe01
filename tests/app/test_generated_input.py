"""Generated input against every operation, with ids of rows that exist: no server error, and every answer as the document says."""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings

from tests.app.every_route import World
from tests.app.test_routes import ANSWER_S, CHECKS

SECONDS = 12.0
"""After which the fast form begins no further round over all operations."""
EXAMPLES = 10
"""Of every operation, in each part of the slow form."""


def operations(world: World) -> list[Any]:
    """Sort operations: those that read before those that change; what these leave behind is then the same in every run."""
    # the event stream of a job has no end of its own
    schema = schemathesis.openapi.from_asgi("/api/v1/openapi.json", world.app, headers=dict(world.admin.headers)).exclude(
        path_regex="events$"
    )
    return sorted((found.ok() for found in schema.get_all_operations()), key=order)


def order(operation: Any) -> tuple[bool, bool]:
    """Place changes after what reads, and after them the end of studies and sites, and their opening again."""
    return operation.method.lower() != "get", operation.path.endswith(("/end", "/reopen"))


def conforms(world: World, operation: Any, examples: int, number: int) -> list[int]:
    """Run generated cases of one operation, on rows that exist; the statuses of their answers."""
    ids = world.ids_of(operation.method.lower(), operation.path)
    headers = {"Authorization": world.admin.headers["authorization"]}
    answered = []

    @seed(number)
    @given(case=operation.as_strategy())
    @settings(max_examples=examples, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck), database=None)
    def run(case: Any) -> None:
        case.path_parameters = {name: ids.get(name, value) for name, value in (case.path_parameters or {}).items()}
        for place in (case.query, case.body):
            if isinstance(place, dict):
                place |= {name: ids[name] for name in place.keys() & ids.keys()}
        answered.append(case.call_and_validate(headers=headers, checks=CHECKS, timeout=ANSWER_S).status_code)

    run()
    return answered


def round_of(world: World, examples: int, number: int) -> list[int]:
    """Run every operation once; return the statuses of all answers. Raises AssertionError with every fault, not only the first."""
    faults, answered = [], []
    for operation in operations(world):
        try:
            answered += conforms(world, operation, examples, number)
        except (Exception, ExceptionGroup) as fault:
            faults.append(f"{operation.method} {operation.path}: {str(fault)[:1500]}")
    assert not faults, "\n\n".join(faults)
    return answered


def test_generated_input_on_rows_that_exist_is_answered_as_described(world: World) -> None:
    begun = time.monotonic()
    answered = round_of(world, 1, 0)
    assert len(answered) >= 100
    assert sum(status < 300 for status in answered) >= 40, "the rows are there"
    number = 1
    while time.monotonic() - begun < SECONDS:
        round_of(world, 1, number)
        number += 1


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("number", range(100, 103))
def test_much_generated_input_on_rows_that_exist_is_answered_as_described(world: World, number: int) -> None:
    answered = round_of(world, EXAMPLES, number)
    by_status = dict(sorted(Counter(answered).items()))
    print(f"{len(operations(world))} operations, {len(answered)} cases, {by_status}")  # noqa: T201 - for docs/reliability.md
    assert len(answered) >= EXAMPLES * len(operations(world)) // 2
    assert sum(status < 300 for status in answered) >= 40, "the rows are there"
