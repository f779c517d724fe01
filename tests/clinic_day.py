"""A visit with an approved plan of three sessions: cDBS and random ones."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
from fastapi.testclient import TestClient

NOW = "2026-11-22T10:00:00Z"


@dataclass
class ClinicDay:
    """A visit whose plan is approved, and a client that acts for a user.

    Attributes:
        slots: numbers of the plan's sessions, in order.
    """

    client: TestClient
    visit: int
    plan: int
    slots: list[int] = field(default_factory=list)

    def entry(self, kind: str, payload: dict[str, Any] | None = None, slot: int | None = 0, **more: Any) -> dict[str, Any]:
        """Build an entry as a tablet sends it; `slot` counts from 0, None is the day."""
        of = {} if slot is None else {"plan_item_id": self.slots[slot], "attempt": 1}
        return {
            "uuid": str(uuid.uuid4()), "kind": kind, "payload": payload or {}, "device_time": NOW, "clock_offset_ms": 0, **of, **more,
        }  # fmt: skip

    def send(self, *entries: dict[str, Any], client: TestClient | None = None) -> Any:
        """Send a batch and return the answer."""
        body = {"plan_id": self.plan, "entries": list(entries)}
        return (client or self.client).post(f"/api/v1/visits/{self.visit}/day/entries", json=body)

    def outcomes(self, *entries: dict[str, Any]) -> list[str]:
        """Send entries and return the result of each."""
        answer = self.send(*entries)
        assert answer.status_code == 200, answer.text
        return [r["outcome"] for r in answer.json()["results"]]


@pytest.fixture
def clinic_day(client: TestClient, participant_code: str, sign_plan: Callable[..., Any]) -> ClinicDay:
    """Visit 2 of P1 with an approved plan."""
    visit = client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 2, "date": "2099-11-22"}).json()["id"]
    drafted = client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": [], "random_sessions": 2, "seed": 1})
    assert drafted.status_code == 201, drafted.text
    approved = sign_plan(visit)
    assert approved.status_code == 200, approved.text
    day = client.get(f"/api/v1/visits/{visit}/day").json()
    return ClinicDay(client, visit, day["plan_id"], [slot["plan_item_id"] for slot in day["slots"]])
