"""What a sweep's page says of policies that should not be believed: below the baselines, not surely above cDBS, beyond the data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning.models import Policy, Sweep
from app.learning.policies.baselines import ONNX, constant_onnx
from app.learning.snapshots.buffers import read_buffer
from app.learning.snapshots.service import take_snapshot
from app.learning.training.compute import gains_over_cdbs
from app.platform import files
from app.platform.jobs import service as jobs
from app.study.repository import participant_by_code
from ml.policies.policy import ConstantPolicy
from ml.trajectories import ReplayBuffer

Upload = Callable[..., int]
Store = Callable[..., Sweep]
BELOW = "Below what the random controller tried"
NOT_ABOVE = "No policy of this sweep is estimated above cDBS with confidence"
NOT_BETTER = "No policy of this sweep scores above a controller that learns nothing"


def metrics(score: float, gain: float, low: float, below: float | None) -> dict[str, Any]:
    return {
        "held_out": {"update": [10], "score": [score]},
        "last": {},
        "best_update": 10,
        "gain_over_cdbs": {"value": gain, "low": low, "standard_error": 1.0},
        "below_bound": None if below is None else {"bound": 0.3, "share": below},
    }


@pytest.fixture
def store(upload: Upload, db: Session) -> Store:
    """Store a sweep of policies with given metrics, without training them."""
    upload("random")

    def make(*each: dict[str, Any]) -> Sweep:
        db.rollback()
        participant = participant_by_code(db, "P1", SYSTEM)
        snapshot = take_snapshot(db, participant, SYSTEM)
        job = jobs.submit(db, "train", participant.id, {}, "ada")
        rows = [{"controller": "cDBS", "score": 5.0, "mean_amplitude": 1.0}]
        sweep = Sweep(
            participant_id=participant.id, name="s", snapshot_id=snapshot.id, job_id=job.id, config={}, code_version="0", created_by="ada",
            baselines={"rows": rows, "best_constant": 1.0, "held_out_sessions": [1]},
        )  # fmt: skip
        db.add(sweep)
        db.flush()
        for k, told in enumerate(each):
            db.add(
                Policy(
                    participant_id=participant.id,
                    name=f"rl-{k}",
                    kind="trained",
                    algorithm="ddpg",
                    snapshot_id=snapshot.id,
                    settings_version_id=snapshot.settings_version_id,
                    sweep_id=sweep.id,
                    config={},
                    seed=k,
                    metrics=told,
                    code_version="0",
                    onnx_sha256=files.store(db, constant_onnx(0.5, 10), ONNX).sha256,
                    created_by="ada",
                )
            )
        db.commit()
        return sweep

    return make


def test_policies_that_score_below_cdbs_and_whose_gains_may_be_losses_are_told_so(store: Store, client: TestClient) -> None:
    sweep = store(metrics(4.0, 2.0, -1.0, 0.0), metrics(3.0, 1.0, 0.0, None))
    page = client.get(f"/sweeps/{sweep.id}").text
    assert NOT_BETTER in page
    assert "The best of those is cDBS" in page
    assert NOT_ABOVE in page
    assert BELOW not in page


def test_the_policy_with_the_largest_lower_bound_is_named_and_not_that_of_the_largest_gain(store: Store, client: TestClient) -> None:
    sweep = store(metrics(9.0, 8.0, 0.5, 0.05), metrics(7.0, 3.0, 2.0, 0.0))
    page = client.get(f"/sweeps/{sweep.id}").text
    assert "rl-1 has the largest lower bound" in page
    assert not any(words in page for words in (NOT_BETTER, NOT_ABOVE, BELOW))
    told = client.get(f"/api/v1/sweeps/{sweep.id}").json()["candidates"]
    assert [(c["name"], c["gain_over_cdbs"], c["gain_low"], c["below_bound"]) for c in told] == [
        ("rl-0", 8.0, 0.5, 0.05),
        ("rl-1", 3.0, 2.0, 0.0),
    ]


def test_a_policy_below_the_random_controllers_bound_in_more_than_a_twentieth_of_steps_is_flagged(
    store: Store, client: TestClient, db: Session
) -> None:
    sweep = store(metrics(9.0, 8.0, 0.5, 0.051), metrics(7.0, 3.0, 2.0, 0.05))
    page = client.get(f"/sweeps/{sweep.id}").text
    assert BELOW in page
    assert "rl-0 asks for less than 30 % of the cDBS amplitude in 5 % of the buffer's steps." in page
    low, high = db.query(Policy).order_by(Policy.id)
    assert BELOW in client.get(f"/participants/P1/policies/{low.id}").text
    assert BELOW not in client.get(f"/participants/P1/policies/{high.id}").text


def test_a_sweep_from_before_gains_were_estimated_has_a_page_without_them(store: Store, client: TestClient) -> None:
    sweep = store({"held_out": {"update": [10], "score": [6.0]}, "last": {}, "best_update": 10})
    page = client.get(f"/sweeps/{sweep.id}").text
    assert not any(words in page for words in (NOT_ABOVE, BELOW, "largest lower bound"))


@pytest.fixture
def buffer(upload: Upload, db: Session) -> ReplayBuffer:
    """Four random and two cDBS sessions of a participant whose beta falls with the amplitude."""
    for controller in ("random", "random", "cdbs", "random", "random", "cdbs"):
        upload(controller)
    db.rollback()
    snapshot = take_snapshot(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    db.commit()
    return read_buffer(snapshot.file_sha256)


def test_cdbs_gains_nothing_over_itself_and_no_stimulation_loses_surely(buffer: ReplayBuffer) -> None:
    same, off = gains_over_cdbs(buffer, [ConstantPolicy(1.0), ConstantPolicy(0.0)])
    assert same == {"value": 0.0, "low": 0.0, "high": 0.0, "standard_error": 0.0, "level": 0.9}
    assert off is not None
    assert off["low"] < off["value"] < 0
