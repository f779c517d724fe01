"""Four calls that one follows first to learn the code, and the modules that each enters: no more than `tests/architecture` records."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.ingest.uploads import compute, reading
from app.learning.policies import constant_onnx
from app.platform.jobs import registry
from app.platform.kept import forget
from ml.progress import silent
from tests.app.conftest import table
from tests.architecture.calls import modules_entered
from tests.architecture.measure import unlike_record

PAGE = {"Accept": "text/html"}


@pytest.fixture
def caller(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> TestClient:
    """A client; requests run in threads of their own from now on, as the tracer needs."""
    monkeypatch.setattr(TestClient, "portal", None)
    return TestClient(client.app, headers=client.headers)


def decode_here_too(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Run what a limited child does in this process as well, before the child does it: no tracer sees the child."""
    compute.prepare()  # as the process does whose forks decode: what is loaded first in a call is not part of it
    limited = reading.run_limited

    def both(reference: str, params: dict[str, Any], *more: Any) -> dict[str, Any]:
        registry.load_compute(reference)(params, folder, silent)
        return limited(reference, params, *more)

    monkeypatch.setattr(reading, "run_limited", both)


def test_a_call_enters_no_more_modules(
    client: TestClient,
    caller: TestClient,
    db: Session,
    study_world: Any,
    sign_plan: Callable[..., Any],
    rng: np.random.Generator,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    record_property: Callable[[str, int], None],
) -> None:
    calls: dict[str, set[str]] = {}
    decode_here_too(monkeypatch, tmp_path)
    session = {"participant": "P1", "visit": 1, "controller": "random"}
    with modules_entered() as calls["upload to trace"]:
        sent = caller.post("/api/v1/uploads", data=session, files={"file": ("a.csv", table(rng.uniform(0.3, 1.0, 20), rng))})
    assert sent.status_code == 201, sent.text
    policies = [
        client.post("/api/v1/participants/P1/policies", data={"name": f"c{a}"}, files={"file": ("c.onnx", constant_onnx(a, 10))}).json()
        for a in (0.5, 0.7)
    ]
    forget()
    for name in ("ranking page", "ranking page, cached"):
        with modules_entered() as calls[name]:
            assert "rl-01" in caller.get("/participants/P1/ranking", headers=PAGE).text
    db.execute(text("update visit set date = :day where id = :id"), {"day": datetime.now(UTC).date(), "id": study_world.visit})
    db.commit()
    draft = {"policy_ids": [p["id"] for p in policies], "seed": 7, "min_ma": 0.5, "random_sessions": 1, "minutes_per_session": 5}
    assert client.post(f"/api/v1/visits/{study_world.visit}/plan", json=draft).status_code == 201
    with modules_entered() as calls["sign a plan"]:
        signed = sign_plan(study_world.visit)
    assert signed.status_code == 200, signed.text
    with modules_entered() as calls["bundle"]:
        bundle = caller.get(f"/api/v1/visits/{study_world.visit}/plan/sessions/1/bundle")
    assert bundle.status_code == 200, bundle.text
    assert "app.planning.bundles.slots" in calls["bundle"]
    assert "ml.formats.tables.steps" in calls["upload to trace"], "a child decodes, and is traced"
    values = {f"modules entered: {name}": len(modules) for name, modules in calls.items()}
    for name, value in values.items():
        record_property(name, value)  # `measure --traced` reads it
    assert unlike_record(values, details=calls, exact=False) == []
