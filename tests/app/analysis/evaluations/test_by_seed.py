"""Methods of evaluation by seed: against sessions recorded after the snapshot, and only where nothing but the seed differs."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.estimates.service import store_evaluation
from app.learning.snapshots import take_snapshot
from app.study.repository import participant_by_code
from app.tables.learning import BufferSnapshot
from tests.app.evaluations import estimate, policies  # noqa: F401 (a fixture)
from tests.app.words import above_fold, drawn_above_fold, methods_named

PATH = "/api/v1/participants/P1/analyses/evaluations"
Upload = Callable[..., int]


def evaluated(db: Session, snapshot: BufferSnapshot, seed: int, horizon: int, values: dict[int, float], preset: str = "full") -> None:
    """Store an evaluation of one seed."""
    table = {"estimates": {str(i): estimate("dlsm", v) for i, v in values.items()}}
    config = {"seed": seed, "preset": preset}
    store_evaluation(
        db, job_id=None, created_by="test", snapshot=snapshot, horizon_steps=horizon, candidates=list(values), results={"dlsm": table},
        config=config,
    )  # fmt: skip
    db.commit()


def test_seeds_of_one_horizon_stand_together(
    client: TestClient,
    db: Session,
    policies: list[int],  # noqa: F811
    upload: Upload,
) -> None:
    db.rollback()
    snapshot = take_snapshot(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    db.commit()
    values = dict.fromkeys(policies, 80.0)
    for seed, horizon in ((0, 60), (1, 10), (2, 10)):
        evaluated(db, snapshot, seed, horizon, values)
    before = client.get(PATH).json()
    assert (before["seeds"], before["policies"], before["rows"]) == ([1, 2], 0, [])
    assert "0 of the policies" in before["text"]
    later = [
        upload("rl", level=0.5, policy=policy, qoc={"grasp_hz": 2.0 + 0.1 * k, "rating": 7, "tremor_percent": 10.0})
        for k, policy in enumerate(policies[:2])
    ]
    found = client.get(PATH).json()
    assert (found["seeds"], found["policies"]) == ([1, 2], 2)
    assert {r["seed"] for r in found["rows"]} == {1, 2}
    # equal estimates under equal horizons have equal errors
    assert len({round(r["mae"], 9) for r in found["rows"]}) == 1
    # estimates of another size are not the same methods under other seeds, and policies that one seed lacks are compared under none
    evaluated(db, snapshot, 5, 10, dict.fromkeys(policies[:2], 70.0), preset="quick")
    assert client.get(PATH).json() == found
    evaluated(db, snapshot, 3, 60, values)
    evaluated(db, snapshot, 4, 60, dict.fromkeys(policies[:2], 80.0))
    longer = client.get(PATH).json()
    assert longer["seeds"] == [0, 3, 4]
    assert {r["policies"] for r in longer["rows"]} == {2}
    assert longer["rows"][0]["mae"] != pytest.approx(found["rows"][0]["mae"])
    shown = client.get("/participants/P1/analyses/evaluations").text
    assert all(f'href="/sessions/{session}"' in shown for session in later), "the sessions behind the numbers are a click away"
    assert shown.count("data-chart") >= 1
    assert methods_named(f"{above_fold(shown)} | {drawn_above_fold(shown, str)}") == [], "methods stand in a fold"
    assert "1 way to predict what a policy would do, each with 3 seeds of its random numbers, on 2 policies" in above_fold(shown)
    assert len(client.get("/participants/P1/analyses/evaluations.csv").text.splitlines()) == 4
