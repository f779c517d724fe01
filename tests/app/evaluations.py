"""Three policies made elsewhere, and evaluations with estimates of known values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.estimates.service import store_evaluation
from app.learning.policies import constant_onnx, ensure_baselines
from app.learning.snapshots import collect, take_snapshot
from app.study.repository import participant_by_code
from ml.ope.estimate import Estimate
from ml.ope.posterior import verdict
from ml.ope.support.behaviour_map import COLUMNS, DOSES, BehaviourMap, Curve
from ml.ope.support.coverage import thin
from tests.ml.ope.posterior.draws import N, cdbs, constructed

Upload = Callable[..., int]


def estimate(method: str, value: float, *, supported: bool = True, spread: float = 1.0, draws: Sequence[float] = ()) -> dict[str, Any]:
    return Estimate(
        method=method,
        value=value,
        low=value - spread,
        high=value + spread,
        level=0.9,
        standard_error=spread / 1.64,
        step_return=value - 80,
        end_reward=80.0,
        predicted={"energy": 0.4, "mean_beta": 0.9, "grasp_hz": 2.1, "rating": 7.5, "tremor_percent": 12.0},
        supported=supported,
        flags=() if supported else (thin(0.6, "logged", low=0.3, high=1.0),),
        n=100,
        details={"draws": list(draws)} if draws else {},
    ).to_json()


def judged(value: float, **changed: Any) -> dict[str, Any]:
    """Build a posterior estimate whose verdict is known: worth a test, but for what `changed` (`tests/ml/ope/posterior/draws.py`)
    states.
    """
    return replace(constructed(value=value, **changed), step_return=value - 80, end_reward=80.0).to_json()


@pytest.fixture
def policies(client: TestClient, upload: Upload, begin_with: Callable[[str, Callable[[], list[int]]], list[int]]) -> list[int]:
    """Ids of three policies made elsewhere, for a participant with four sessions."""

    def make() -> list[int]:
        for controller in ("random", "random", "cdbs", "random"):
            upload(controller)
        files = {f"p{k}": {"file": (f"p{k}.onnx", constant_onnx(0.4 + 0.2 * k, 10))} for k in range(3)}
        answers = [client.post("/api/v1/participants/P1/policies", data={"name": n}, files=file) for n, file in files.items()]
        return [int(answer.json()["id"]) for answer in answers]

    return begin_with("three_policies", make)


@pytest.fixture
def judge(db: Session, policies: list[int], monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Function that stores an evaluation with the posterior of policies by id and that of cDBS; chances are the shares of their draws."""
    monkeypatch.setattr(verdict, "CALIBRATION", ((0.0, 0.0), (1.0, 1.0)))

    def store(
        posterior: dict[int, dict[str, Any]],
        reference: dict[str, Any] | None = None,
        shapes: dict[str, Any] | None = None,
        candidates: Sequence[int] | None = None,
        job_id: str | None = None,
        **more: Any,
    ) -> int:
        db.rollback()
        participant = participant_by_code(db, "P1", SYSTEM)
        snapshot = take_snapshot(db, participant, SYSTEM)
        baselines = ensure_baselines(db, participant, snapshot, collect(db, participant).buffer, "test")
        held = next(p.id for p in baselines if p.config.get("amplitude") == 1.0)
        table = {str(i): e for i, e in posterior.items()} | {str(held): reference or cdbs().to_json()}
        row = store_evaluation(
            db,
            job_id=job_id,
            created_by="test",
            snapshot=snapshot,
            horizon_steps=snapshot.median_steps,
            candidates=list(posterior) if candidates is None else candidates,
            results={"posterior": {"estimates": table} | ({"dose_shapes": shapes} if shapes else {})},
            config={},
            **more,
        )
        db.commit()
        return row.id

    return store


@pytest.fixture
def evaluate(db: Session, policies: list[int]) -> Callable[..., int]:
    """Function that stores an evaluation; `dlsm` values by policy, further methods by name."""

    def store(dlsm: dict[int, dict[str, Any]], baselines: dict[float, float] | None = None, **others: dict[str, Any]) -> int:
        db.rollback()
        participant = participant_by_code(db, "P1", SYSTEM)
        snapshot = take_snapshot(db, participant, SYSTEM)
        made = {
            p.config.get("amplitude"): p.id for p in ensure_baselines(db, participant, snapshot, collect(db, participant).buffer, "test")
        }
        table = {str(i): e for i, e in dlsm.items()}
        table |= {str(made[a]): estimate("dlsm", v) for a, v in (baselines or {}).items()}
        row = store_evaluation(
            db,
            job_id=None,
            created_by="test",
            snapshot=snapshot,
            horizon_steps=snapshot.median_steps,
            candidates=list(dlsm),
            results={"dlsm": {"estimates": table}, **others},
            config={},
        )
        db.commit()
        return row.id

    return store


# Predictions and behaviour for pages to be looked at, which follow from a policy's dose, with a spread of chance.

SPREAD = {"energy": 0.02, "grasp_hz": 0.05, "rating": 0.3, "tremor_percent": 2.0}


def made_elsewhere(client: TestClient, doses: Mapping[str, float]) -> list[int]:
    """Upload policies of P1 with constant doses, fractions of cDBS, by name; return their ids."""
    files = [(name, {"file": (f"{name}.onnx", constant_onnx(dose, 10))}) for name, dose in doses.items()]
    answers = [client.post("/api/v1/participants/P1/policies", data={"name": name}, files=file) for name, file in files]
    return [int(answer.json()["id"]) for answer in answers]


def predicted(dose: float, rng: np.random.Generator, nearly_off: float | None = None, **middles: float) -> dict[str, Any]:
    """Build what is predicted of a policy of some mean dose, and what it does; `middles` replaces outcomes."""
    middle = {"energy": dose**2, "grasp_hz": 2.4 - 0.9 * (1 - dose) ** 2, "rating": 7.2 - 2 * (1 - dose) ** 2}
    middle |= {"tremor_percent": 8 + 60 * (1 - dose) ** 2} | middles
    off = float(dose < 0.2) if nearly_off is None else nearly_off
    return {
        "outcome_draws": {k: np.abs(rng.normal(m, SPREAD[k], N)).round(3).tolist() for k, m in middle.items()},
        "behaviour": {"mean_amplitude": dose, "closeness_to_cdbs": 1 - dose, "below_cdbs_20_percent": off},
    }


def behaviour(doses: Mapping[int, float]) -> dict[str, Any]:
    """Build what an evaluation stores of policies that go up with beta around their dose, over a cloud of recorded sessions."""
    centre = [1.0 + 0.1 * k for k in range(COLUMNS)]
    tried = tuple(tuple(int(30 * (row % 4 == 0 and row > 6) / (1 + k)) for row in range(DOSES)) for k in range(COLUMNS))
    curves = {str(i): [float(np.clip(d + 0.1 * (b - 2.0), 0, 1)) for b in centre] for i, d in doses.items()}
    shapes = {i: Curve(tuple(c), tuple(v - 0.05 for v in c), tuple(v + 0.05 for v in c)) for i, c in curves.items()}
    apart = {str(i): {str(j): round(abs(d - e), 4) for j, e in doses.items() if j > i} for i, d in doses.items()}
    return {"policies": {}, "map": BehaviourMap((*centre, centre[-1] + 0.1), tried, shapes, apart).to_json()}
