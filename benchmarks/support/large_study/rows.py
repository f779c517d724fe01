"""A large study for measuring pages: participants x visits x sessions x policies, written through the tables' models, always the same.

Numbers are drawn, not simulated: pages take as long for them as for real ones. Policies are constants in ONNX files, estimates have draws
as the posterior has them, learning curves as many points as a full training.
"""

from __future__ import annotations

import datetime as dt
import hashlib
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from app.accounts import service as accounts
from app.accounts.permissions import SYSTEM
from app.evaluation.estimates.service import store_evaluation
from app.learning.policies import constant_onnx, ensure_baselines
from app.learning.snapshots import collect, take_snapshot
from app.platform import files
from app.study import blinding
from app.study.participation import ParticipantIn, enrol
from app.study.traces import pack
from app.tables.accounts import Role
from app.tables.jobs import Job, JobEvent, JobStatus, JobStep
from app.tables.learning import BufferSnapshot, Policy, Sweep
from app.tables.outcomes import QocRevision
from app.tables.participants import Participant
from app.tables.recordings import Device, Recording, Trace
from app.tables.sessions import Controller, SessionConditions, SessionSegment, StudySession
from app.tables.visits import Visit
from ml.ope.estimate import Estimate

EMAIL, PASSWORD = "admin@clinic.example", "pages of a large study"
STEPS, LEAD = 300, 10
DAY = ("random", "cdbs", "rl", "cdbs", "distilled", "random", "no_dbs", "rl")
METHODS = ("dlsm", "linear", "fqe", "wdr")
DRAWS, CURVE_POINTS, PER_SWEEP = 200, 40, 8
FIRST_DAY = dt.date(2025, 1, 7)
BETWEEN_VISITS = dt.timedelta(days=28)


@dataclass(frozen=True)
class Extent:
    """Extent of the study."""

    participants: int = 20
    visits: int = 12
    sessions: int = 8
    policies: int = 40

    @property
    def name(self) -> str:
        """Of a folder that keeps this study."""
        return "x".join(str(n) for n in asdict(self).values())


def add_account(db: Session) -> None:
    """Add the account that looks at the pages."""
    accounts.add_user(db, EMAIL, Role.ADMIN, PASSWORD)


def add_participant(db: Session, number: int, extent: Extent) -> None:
    """Add one participant with everything that pages show of it."""
    rng = np.random.default_rng(number)
    settings = {"xi_beta": 1.0, "cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"}
    participant = enrol(db, ParticipantIn.model_validate({"code": f"P{number:02d}", "settings": settings}), SYSTEM)
    db.flush()
    policies = [_policy_file(db, i) for i in range(extent.policies)]
    # Policies are of the first visit's snapshot, so that later sessions can have run them
    snapshot: BufferSnapshot | None = None
    rows: list[Policy] = []
    for visit in range(1, extent.visits + 1):
        _add_visit(db, participant, visit, extent.sessions, [p.id for p in rows], rng)
        if snapshot is None:
            db.expire_all()
            snapshot = take_snapshot(db, participant, SYSTEM)
            rows = _add_policies(db, participant, snapshot, policies, rng)
    db.expire_all()
    newest = take_snapshot(db, participant, SYSTEM)
    baselines = ensure_baselines(db, participant, newest, collect(db, participant).buffer, "bench")
    everyone = [*rows, *baselines]
    for of in (snapshot, newest):
        store_evaluation(
            db, job_id=None, created_by="bench", snapshot=of, horizon_steps=of.median_steps, candidates=[p.id for p in rows],
            results=_results(everyone, rng), config={"methods": ["posterior", *METHODS]},
        )  # fmt: skip


def _add_visit(db: Session, participant: Participant, number: int, sessions: int, policies: list[int], rng: np.random.Generator) -> None:
    day = FIRST_DAY + (number - 1) * BETWEEN_VISITS
    visit = Visit(participant_id=participant.id, number=number, date=day)
    device = Device(participant_id=participant.id, pseudonym=f"{participant.code}-{number}", kind="table")
    db.add_all([visit, device])
    db.flush()
    held: list[tuple[StudySession, Recording, str]] = []
    for k in range(sessions):
        name = DAY[k % len(DAY)] if policies else DAY[k % 2]
        began = dt.datetime.combine(day, dt.time(9), dt.UTC) + k * dt.timedelta(minutes=25)
        session = StudySession(
            visit_id=visit.id, ordinal=k + 1, duration_s=2.0 * STEPS, started_at=began, medication_h=round(float(rng.uniform(1, 5)), 1)
        )  # fmt: skip
        learned = name in ("rl", "distilled")
        blinding.assign(session, Controller(name), int(rng.choice(policies)) if learned else None)
        digest = hashlib.sha256(f"{participant.code}/{number}/{k}".encode()).hexdigest()
        recording = Recording(
            participant_id=participant.id, device_id=device.id, fingerprint=digest, clock="table",
            duration_s=2.0 * (STEPS + LEAD), details={},
        )  # fmt: skip
        held.append((session, recording, name))
    db.add_all([s for s, _, _ in held] + [r for _, r, _ in held])
    db.flush()
    rest: list[Any] = []
    for session, recording, name in held:
        rest += _rows_of_session(session, recording, name, rng)
    db.add_all(rest)
    db.flush()


def _rows_of_session(session: StudySession, recording: Recording, name: str, rng: np.random.Generator) -> list[Any]:
    n = STEPS + LEAD
    levels = {"cdbs": 1.0, "no_dbs": 0.0}
    fraction = np.full(n, levels[name]) if name in levels else np.repeat(rng.uniform(0.3, 1.0, n // 10 + 1), 10)[:n]
    beta = np.abs(1.6 - 0.7 * fraction + 0.2 * rng.standard_normal(n)) + 0.05
    offset = float(2 * LEAD)
    rows: list[Any] = [
        SessionSegment(session_id=session.id, recording_id=recording.id, start_s=offset, stop_s=offset + session.duration_s),
        QocRevision(
            session_id=session.id, revision=1, entered_by="bench", grasp_hz=round(float(2.4 + 0.3 * rng.standard_normal()), 2),
            rating=int(np.clip(round(7 + rng.standard_normal()), 1, 10)), tremor_percent=round(float(rng.uniform(0, 30)), 1),
        ),
        SessionConditions(
            session_id=session.id, revision=1, origin="settings", lower_bound=0.3, window=10, period_s=2.0, xi_beta=1.0,
            lead_amplitude_ma=3.0 * float(fraction[LEAD - 1]), cdbs_amplitude_ma=3.0, entered_by="bench",
            design_parameters={}, programming=[],
        ),
    ]  # fmt: skip
    for stream, unit, source, values in (("beta", "uV", "table", beta), ("amplitude", "fraction", "table", fraction)):
        packed, valid = pack(values, np.ones(n, dtype=bool))
        rows.append(
            Trace(
                recording_id=recording.id, decode_version=1, stream=stream, unit=unit, source=source, dt_s=2.0, first_end_s=2.0, n=n,
                values_f32=packed, valid_bits=valid,
            )
        )  # fmt: skip
    return rows


def _policy_file(db: Session, i: int) -> str:
    return str(files.store(db, constant_onnx(round(0.3 + 0.015 * i, 4), 10)).sha256)


def _add_policies(
    db: Session, participant: Participant, snapshot: BufferSnapshot, stored: list[str], rng: np.random.Generator
) -> list[Policy]:
    """Add sweeps of eight, the last policy of each being a student of the one before."""
    rows: list[Policy] = []
    for first in range(0, len(stored), PER_SWEEP):
        members = range(first, min(first + PER_SWEEP, len(stored)))
        job = _add_job(db, participant, f"{participant.code}-{first}", len(members), rng)
        sweep = Sweep(
            participant_id=participant.id, name=f"sweep {first // PER_SWEEP + 1}", snapshot_id=snapshot.id, job_id=job.id,
            config={"algorithms": ["ddpg"]}, baselines=_scored(), code_version="bench", created_by="bench",
        )  # fmt: skip
        db.add(sweep)
        db.flush()
        for i in members:
            student = i == members[-1] and len(members) > 1
            name, kind, algorithm = ("student", "distilled", "distilled") if student else ("rl", "trained", "ddpg")
            rows.append(
                Policy(
                    participant_id=participant.id, name=f"{name}-{i + 1:02d}", kind=kind, algorithm=algorithm,
                    teacher_id=rows[-1].id if student else None, snapshot_id=snapshot.id, job_id=job.id, job_step=f"train/{i}",
                    settings_version_id=snapshot.settings_version_id, sweep_id=None if student else sweep.id,
                    config={"window": 10, "seed": i, "actor_lr": 1e-4 * (i + 1), "updates": 4000}, seed=i, onnx_sha256=stored[i],
                    metrics=_metrics(rng), code_version="bench", created_by="bench",
                )
            )  # fmt: skip
            db.add(rows[-1])
            db.flush()
    return rows


def _scored() -> dict[str, Any]:
    rows = [
        {"controller": "cDBS", "score": 0.5, "mean_amplitude": 1.0},
        {"controller": "constant 0.70", "score": 0.2, "mean_amplitude": 0.7},
    ]
    return {"rows": rows, "best_constant": 1.0, "held_out_sessions": [1]}


def _metrics(rng: np.random.Generator) -> dict[str, Any]:
    updates = [100 * (k + 1) for k in range(CURVE_POINTS)]
    return {
        "curve": {"update": updates, "mean_q": rng.normal(size=CURVE_POINTS).round(4).tolist(),
                  "action_distance": rng.uniform(0, 0.4, CURVE_POINTS).round(4).tolist()},
        "held_out": {"update": updates, "score": rng.normal(size=CURVE_POINTS).round(4).tolist(),
                     "over_logged": rng.normal(size=CURVE_POINTS).round(4).tolist(), },
        "best_update": updates[-1], "mean_amplitude_on_buffer": round(float(rng.uniform(0.4, 1.0)), 4),
        "last": {"action_distance": round(float(rng.uniform(0, 0.4)), 4), "saturated": round(float(rng.uniform(0, 0.2)), 4)},
    }  # fmt: skip


def _add_job(db: Session, participant: Participant, name: str, steps: int, rng: np.random.Generator) -> Job:
    began = dt.datetime(2025, 1, 8, 9, tzinfo=dt.UTC)
    digest = hashlib.sha256(name.encode()).hexdigest()
    job = Job(
        id=f"{digest[:8]}-{digest[8:12]}-{digest[12:16]}-{digest[16:20]}-{digest[20:32]}", participant_id=participant.id, kind="train",
        status=JobStatus.SUCCEEDED, progress=1.0, params={"preset": "full", "algorithms": ["ddpg"], "count": steps}, result={},
        code_version="bench", created_by="bench", created_at=began, started_at=began, finished_at=began + dt.timedelta(minutes=20),
    )  # fmt: skip
    db.add(job)
    db.flush()
    events: list[JobEvent] = []
    for i in range(steps):
        db.add(
            JobStep(
                job_id=job.id, key=f"train/{i}", title=f"Train policy {i + 1} (DDPG)", position=i, status=JobStatus.SUCCEEDED, progress=1.0,
                attempts=1, started_at=began, finished_at=began + dt.timedelta(minutes=2),
            )
        )  # fmt: skip
        for k in range(CURVE_POINTS):
            values = {n: round(float(rng.normal()), 4) for n in ("mean_q", "critic_loss", "action_distance")}
            points = [{"x": 100 * (k + 1), "values": values}]
            events.append(JobEvent(job_id=job.id, step_key=f"train/{i}", kind="points", data={"points": points}))
    db.add_all(events)
    db.flush()
    return job


def _results(policies: list[Policy], rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {"posterior": {"estimates": {str(p.id): _posterior(p, rng).to_json() for p in policies}}}
    for method in METHODS:
        found[method] = {"estimates": {str(p.id): _estimate(method, rng).to_json() for p in policies}}
    return found


def _estimate(method: str, rng: np.random.Generator) -> Estimate:
    value, spread = float(rng.normal(-80, 12)), float(rng.uniform(2, 9))
    draws = [round(float(v), 4) for v in rng.normal(value, spread, DRAWS)]
    return Estimate(
        method=method, value=value, low=value - spread, high=value + spread, level=0.9, standard_error=spread / 1.64,
        step_return=value - 80, end_reward=80.0, predicted=_predicted(rng), supported=True, flags=(), n=90, details={"draws": draws},
    )  # fmt: skip


def _predicted(rng: np.random.Generator) -> dict[str, float]:
    drawn = {"energy": float(rng.uniform(0.2, 1)), "grasp_hz": float(rng.normal(2.2, 0.1))}
    return drawn | {"mean_beta": 0.9, "rating": 7.2, "tremor_percent": 11.0}


def _posterior(policy: Policy, rng: np.random.Generator) -> Estimate:
    held = policy.config.get("amplitude")
    dose = float(held) if held is not None else float(rng.uniform(0.45, 1.0))
    middle = {"energy": dose**2, "grasp_hz": 2.4 - 0.3 * (1 - dose), "rating": 7.2 - (1 - dose), "tremor_percent": 10 + 8 * (1 - dose)}
    spread = {"energy": 0.02, "grasp_hz": 0.12, "rating": 0.5, "tremor_percent": 3.0}
    outcome = {k: [round(float(v), 4) for v in np.abs(rng.normal(m, spread[k], DRAWS))] for k, m in middle.items()}
    near = {"near_sessions": 4, "near_visits": 2, "leverage": 0.1, "dose": dose, "lowest_supported": 0.5}
    details: dict[str, Any] = {
        "draws": [round(float(v), 4) for v in rng.normal(-60 - 40 * (1 - dose), 8, DRAWS)], "outcome_draws": outcome, "support": near,
        "behaviour": {"below_cdbs_20_percent": 0.0, "closeness_to_cdbs": 1 - dose, "mean_amplitude": dose},
        "skill": {"told": True, "reasons": [], "held_out_correlation": 0.6}, "weights": {"linear": 0.7, "impulse": 0.3},
    }  # fmt: skip
    value = float(np.mean(details["draws"]))
    return Estimate("posterior", value, value - 13, value + 13, 0.9, 8.0, value - 80, 80.0, _predicted(rng), True, (), 90, details)
