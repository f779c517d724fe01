"""A job that found a threshold rule, for tests of what shows it."""

from __future__ import annotations

import uuid

from sqlalchemy.orm import Session

from app.platform.database import now
from app.study import cdbs_amplitude
from app.tables.jobs import Job, JobStatus
from app.tables.learning import Policy
from app.tables.participants import Participant
from ml.policies.threshold_rule import ThresholdRule

RULE = ThresholdRule(
    mode="dual", lower_threshold=20.0, upper_threshold=30.0, lower_ma=0.8, upper_ma=1.0, ramp_up_s=150.0, ramp_down_s=300.0,
    onset_s=1.2, termination_s=1.2, averaging_s=2.0, blanking_s=2.0,
)  # fmt: skip


def add_found_rule(db: Session, policy: Policy, snapshot: int, rule: ThresholdRule = RULE, **changed: object) -> Job:
    """Store a finished job with a rule of a participant whose cDBS amplitude is known; the caller commits."""
    cdbs_ma = cdbs_amplitude.in_force_now(db.get_one(Participant, policy.participant_id), None)
    estimate = {"value": -20.0, "low": -25.0, "high": -15.0, "supported": True, "predicted": {}}
    difference = {"value": -0.5, "low": -2.0, "high": 1.0}
    closeness = {"rms_ma": 0.1, "mean_ma": 0.01, "apart": 0.2, "energy_rule": 0.7, "energy_policy": 0.69, "steps": 900, "sessions": 9}
    found = {
        "rule": rule.to_json(), "closeness": closeness, "close": True, "tried": 900, "below_threshold": [0.3, 0.7],
        "estimates": dict.fromkeys(("rule", "policy", "cdbs"), estimate), "to_policy": difference, "to_cdbs": difference,
        "verdict": {"code": "undecided", "within": 0.6}, "horizon_steps": 300, "cdbs_ma": cdbs_ma, "min_ma": 0.0, "max_ma": cdbs_ma,
        "beta": {"unit": "device units", "source": "percept_lfp", "low_hz": 13.0, "high_hz": 35.0, "period_s": 2.0},
        "snapshot_id": snapshot, "sessions": 9, "steps": 900, "hemisphere": None, "device": "percept_pc",
    }  # fmt: skip
    job = Job(
        id=str(uuid.uuid4()), kind="threshold_rule", participant_id=policy.participant_id, status=JobStatus.SUCCEEDED, progress=1.0,
        message="", params={"policy_id": policy.id}, result=found | changed, code_version="test", created_by="test",
        created_at=now(), started_at=now(), finished_at=now(),
    )  # fmt: skip
    db.add(job)
    db.flush()
    return job
