"""Time of the server for the analyses of four participants with 200 sessions each (processor time: other work does not count)."""

from __future__ import annotations

import time
from statistics import median

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform import kept
from tests.app.analysis.conftest import adder

CONTROLLERS = ("cdbs", "rl", "cdbs", "distilled")


@pytest.fixture
def four_of_200(client: TestClient, db: Session, participant_code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty visits of ten sessions of 10 minutes each, in one transaction."""
    rng = np.random.default_rng(0)
    monkeypatch.setattr(db, "commit", db.flush)
    for code in (participant_code, "P2", "P3", "P4"):
        if code != participant_code:
            settings = {"cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"}
            assert client.post("/api/v1/participants", json={"code": code, "settings": settings}).status_code == 201
        add = adder(db, code)
        for visit in range(1, 21):
            day = rng.normal(0, 0.3)
            for k in range(10):
                name = CONTROLLERS[k % 4]
                level = 1.0 if name == "cdbs" else 0.7
                add(
                    name,
                    beta=(2 + day + 0.2 * rng.random(300)).tolist(),
                    fraction=(level * (1 - 0.1 * rng.random(300))).tolist(),
                    grasp=2.4 + day + 0.1 * rng.normal(),
                    rating=int(np.clip(round(7 + day + rng.normal()), 1, 10)),
                    tremor=float(np.clip(12 + 3 * rng.normal(), 0, 100)),
                    visit=visit,
                    duration_s=600.0,
                )
    monkeypatch.undo()
    db.execute(text("analyze"))
    db.commit()


def milliseconds(client: TestClient, path: str, forget: bool) -> float:
    """Measure the median processor time of this process for a page, over seven calls."""
    found = []
    for _ in range(7):
        if forget:
            kept.forget()
        start = time.process_time()
        assert client.get(path).status_code == 200
        found.append(1000 * (time.process_time() - start))
    return median(found)


@pytest.mark.slow
def test_what_is_kept_answers_at_once(client: TestClient, four_of_200: None) -> None:
    for path in ("/participants/P1/analyses", "/participants/P1/analyses/paper", "/participants/P1/analyses/energy"):
        assert milliseconds(client, path, forget=True) < 300, path
        assert milliseconds(client, path, forget=False) < 150, path
    assert milliseconds(client, "/analyses", forget=False) < 150
