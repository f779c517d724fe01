"""Serious adverse events, for tests of what they hold back."""

from __future__ import annotations

from typing import Any

from fastapi.testclient import TestClient


def event(client: TestClient, policy: int) -> dict[str, Any]:
    """Add a serious fall of P1 under a policy, as it is stored; it is not cleared."""
    body = {"kind": "fall", "severity": "severe", "serious": True, "policy_id": policy}
    answer = client.post("/api/v1/participants/P1/adverse-events", json=body)
    assert answer.status_code == 201, answer.text
    found: dict[str, Any] = answer.json()
    return found


def clear(client: TestClient, found: dict[str, Any]) -> None:
    """Clear it with a reason, as a user who approves plans."""
    given = {"revision": found["revision"], "reason": "she tripped"}
    assert client.post(f"/api/v1/adverse-events/{found['id']}/clearance", json=given).status_code == 200
