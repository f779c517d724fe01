"""Agreement of tablet and service on the same day, each in its own language: what a note may hold, and what entries say."""

from __future__ import annotations

import random
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from pydantic import TypeAdapter

from app.planning.visit_day.record import DeviceTime, contradictions, last_attempt, open_severe, state_of
from app.planning.visit_day.screening import rules, screen
from tests.browser.conftest import Watched
from tests.browser.day_page import open_day
from tests.clinic_day import ClinicDay, clinic_day

__all__ = ["clinic_day"]
pytestmark = pytest.mark.browser

REFUSED = (
    "Felt better since 3.4.26", "on the 3rd of May", "May 2026", "call 555 01 99 or a@b.c", "Ångström was dizzy", "He said O'Brien helped",
    "Łódź", "Mr Smith", "patient 12345", "12 34",
)  # fmt: skip
KEEPABLE = (
    "smith was dizzy",
    "DBS at 2.75 mA, 130 Hz",
    "UPDRS 3, rating 7/10 at 10:15",
    "Sitting. Resting. Walking slower",
    "",
    "Zhivago sat",
)


def test_the_tablet_screens_notes_as_the_service_does(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    watched = window()
    watched.signed_in()
    open_day(watched, clinic_day)
    script = """async ([notes, rules, module]) => {
      const { screen } = await import(module);
      return notes.map((note) => screen(note, rules, ['zhivago']));
    }"""
    found = watched.page.evaluate(script, [[*REFUSED, *KEEPABLE], rules(), _module(watched, "screening.js")])
    assert found == [[{"kind": f.kind, "text": f.text} for f in screen(note, ["zhivago"])] for note in (*REFUSED, *KEEPABLE)]
    assert [bool(f) for f in found] == [True] * len(REFUSED) + [False] * len(KEEPABLE)


def test_the_tablet_reads_entries_as_the_service_does(window: Callable[..., Watched], clinic_day: ClinicDay) -> None:
    days = [_drawn_day(seed) for seed in range(40)]
    watched = window()
    watched.signed_in()
    open_day(watched, clinic_day)
    script = """async ([days, module]) => {
      const r = await import(module);
      const first = (a, b) => (a[0] < b[0] ? -1 : 1);
      return days.map((d) => [[1, 2].map((i) => [r.stateOf(d, i), r.lastAttempt(d, i)]),
        r.contradictions(d).map((rows) => rows.map((e) => e.uuid).sort()).sort(first), r.openSevere(d)?.uuid ?? null]);
    }"""
    found = watched.page.evaluate(script, [days, _module(watched, "record.js")])
    moment = TypeAdapter(DeviceTime).validate_python
    for day, (states, clashes, severe) in zip(days, found, strict=True):
        rows: list[Any] = [SimpleNamespace(**e | {"device_time": moment(e["device_time"])}) for e in day]
        assert states == [[state_of(rows, i), last_attempt(rows, i)] for i in (1, 2)]
        assert clashes == sorted(sorted(e.uuid for e in c.entries) for c in contradictions(rows))
        last = open_severe(rows)
        assert severe == (last.uuid if last else None)
    assert any(clashes for _, clashes, _ in found)
    assert any(severe for _, _, severe in found)


def _drawn_day(seed: int) -> list[dict[str, Any]]:
    """Draw entries as two careless tablets might make them."""
    rng = random.Random(seed)
    entries: list[dict[str, Any]] = []
    payloads: dict[str, list[dict[str, Any]]] = {
        "start": [{}],
        "stop": [{}],
        "session_end": [{}],
        "rating": [{"value": 3}, {"value": 4}],
        "gait": [{"grade": "mild"}, {"grade": "severe"}],
        "skip": [{"reason": "a"}, {"reason": "b"}],
        "repeat": [{"reason": "a"}],
        "clinical_settings": [{}],
    }
    for number in range(rng.randint(1, 14)):
        kind = rng.choice(list(payloads))
        entries.append(
            {
                "uuid": f"{seed:03}-{number:03}",
                "plan_item_id": rng.choice([1, 2]),
                "attempt": rng.choice([1, 1, 2]),
                "kind": kind,
                "payload": rng.choice(payloads[kind]),
                "replaces": [rng.choice(entries)["uuid"]] if entries and rng.random() < 0.25 else [],
                "device_time": f"2026-11-22T10:{rng.randint(0, 59):02}:{rng.randint(0, 59):02}.000Z",
                "clock_offset_ms": rng.choice([None, 0, 1500, -90_000]),
                "entered_by": "a",
            }
        )
    return entries


def _module(watched: Watched, name: str) -> str:
    folder: str = watched.page.get_attribute("script[src*='/visit-day/files/']", "src").rsplit("/", 1)[0]
    return f"{folder}/{name}"
