"""Results of evaluation's child processes, called directly: every method but the DLSM, on data that it can and cannot work on."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy.orm import Session

from app.evaluation.estimates.compute import choose_method, evaluate_method
from app.learning.policies import constant_onnx
from app.platform import files
from app.platform.jobs import StepReport
from ml.mdp import MdpSettings
from ml.ope import registry
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory, to_parquet

FITTED = [m for m in registry.method_keys() if m not in ("dlsm", registry.AGGREGATE)]


def sessions(lead: float = 1.0) -> tuple[SessionTrajectory, ...]:
    """Build nine sessions of three controllers over two visits; `lead` is the beta before them, NaN where recording began with the first
    step.
    """
    rng = np.random.default_rng(5)
    made = []
    for k, controller in enumerate(("random", "cdbs", "random", "no_dbs", "random", "cdbs", "random", "no_dbs", "random")):
        a = {"random": rng.uniform(0.3, 1.0, 50), "cdbs": np.ones(50), "no_dbs": np.zeros(50)}[controller]
        beta = np.empty(50)
        level = 1.1
        for t in range(50):
            level = 0.7 * level + 0.3 * (1.4 - 0.7 * a[t]) + 0.1 * rng.standard_normal()
            beta[t] = max(level, 0.05)
        qoc = Qoc(grasp_hz=2.5 - beta.mean() / 2, rating=float(8 - round(beta.mean())), tremor_percent=40 * (1 - a.mean()))
        lower = 0.3 if controller == "random" else None
        made.append(SessionTrajectory(k + 1, 1 + k // 5, controller, np.full(10, lead), beta, a, qoc, random_bound=lower))
    return tuple(made)


def call(db: Session, buffer: ReplayBuffer, **more: Any) -> dict[str, Any]:
    """Build params of a compute function on a stored buffer, with one policy of constant 0.6."""
    stored = files.store(db, to_parquet(buffer)).sha256
    policy = files.store(db, constant_onnx(0.6, 10)).sha256
    return {
        "snapshot_sha256": stored, "preset": "quick", "seed": 0, "horizon_steps": 50, "policies": [{"id": 7, "sha256": policy}]
    } | more  # fmt: skip


def buffer_of(made: tuple[SessionTrajectory, ...]) -> ReplayBuffer:
    return ReplayBuffer(MdpSettings(xi_beta=1.0), made, "uV", "table")


@pytest.mark.parametrize("method", FITTED)
def test_every_method_estimates_reports_and_gives_json(method: str, db: Session, tmp_path: Path) -> None:
    told: list[dict[str, Any]] = []
    result = evaluate_method(call(db, buffer_of(sessions()), method=method), tmp_path, StepReport(told.append, interval_s=0.0))
    estimate = json.loads(json.dumps(result))["estimates"]["7"]
    assert estimate["method"] == method
    assert estimate["low"] <= estimate["high"]
    assert -65.0 <= estimate["step_return"] <= 0.0  # 50 steps of -1.3 to 0
    shares = [m["progress"] for m in told if m.get("progress") is not None]
    assert shares == sorted(shares)
    assert shares[-1] > 0.9
    if method in ("dlmm", "dual_dice"):
        assert any(name.startswith(method) for m in told for point in m.get("points", []) for name in point["values"])


@pytest.mark.parametrize("method", ["fqe", "wdr", "dual_dice"])
def test_a_method_that_cannot_work_on_the_data_says_why(method: str, db: Session, tmp_path: Path) -> None:
    result = evaluate_method(call(db, buffer_of(sessions(lead=float("nan"))), method=method), tmp_path, StepReport(lambda _: None))
    assert "no session has a complete window of beta before its first step" in result["failed"]
    assert "estimates" not in result


@pytest.mark.parametrize("method", ["posterior", "linear", "impulse", "fqe", "wdr", "dual_dice", "dlmm"])
@pytest.mark.filterwarnings("error")
def test_one_session_is_refused_in_the_same_words_by_every_method_that_fits(method: str, db: Session, tmp_path: Path) -> None:
    first, second, *_ = sessions()
    blank = replace(second, beta=np.full(second.steps, np.nan))
    for made in ((first,), (first, blank)):
        result = evaluate_method(call(db, buffer_of(made), method=method), tmp_path, StepReport(lambda _: None))
        assert re.search(r"needs at least two sessions with usable steps; the buffer has 1$", result["failed"])
        assert "estimates" not in result


def test_the_choice_names_its_table_or_why_there_is_none(db: Session, tmp_path: Path) -> None:
    params = call(db, buffer_of(sessions()), methods=["dlsm", "linear", "fqe", "wis", "aggregate"])
    params["policies"] = []
    found = json.loads(json.dumps(choose_method(params, tmp_path, StepReport(lambda _: None))))["held_out"]
    assert {"linear", "fqe", "wis"} <= {row["method"] for row in found["table"]}
    assert {p["controller"] for p in found["predictions"]} == {"random", "cdbs", "no_dbs"}
    one = params | {"methods": ["dlsm", "pdis"]}
    assert "none of the methods asked for" in choose_method(one, tmp_path, StepReport(lambda _: None))["failed"]


@pytest.mark.parametrize("method", ["posterior", "impulse", "linear", "fqe", "wdr", "dual_dice", "dlmm"])
def test_a_study_without_end_of_session_rewards_still_sees_the_outcomes_predicted(method: str, db: Session, tmp_path: Path) -> None:
    without = MdpSettings(xi_beta=1.0, c2=0.0, c3=0.0, c4=0.0)
    buffer = ReplayBuffer(without, sessions(), "uV", "table")
    estimate = evaluate_method(call(db, buffer, method=method), tmp_path, StepReport(lambda _: None))["estimates"]["7"]
    assert {"energy", "mean_beta", "grasp_hz", "rating", "tremor_percent"} <= set(estimate["predicted"])
    assert estimate["end_reward"] == pytest.approx(0.0, abs=1e-9)
    assert estimate["value"] == pytest.approx(estimate["step_return"], abs=1e-9)
    assert 1.0 <= estimate["predicted"]["rating"] <= 10.0
