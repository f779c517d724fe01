"""How long the service works for the pages and answers of the analyses: four participants with 200 sessions each.

    python benchmarks/analyses.py --quick
    python benchmarks/analyses.py [--repeats 7] [--json FILE]

Makes the study once (twenty visits of ten sessions of 10 minutes, in a database of its own) and asks for every page, first with
nothing kept in memory, then with everything kept. Medians in milliseconds of `cpu`, processor time of the web process, and `wall`, from
the request to the answer, which contains the database's work and waits for whatever else the machine does.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from datetime import date, timedelta
from pathlib import Path
from statistics import median

import numpy as np
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts import service as accounts
from app.accounts.permissions import SYSTEM
from app.main import create_app, leave_to_itself
from app.platform import kept
from app.platform.database import new_session, set_actor, transaction
from app.platform.migrate import migrate
from app.settings import get_settings
from app.study import blinding, repository
from app.study.traces import pack
from app.tables.accounts import Role
from app.tables.outcomes import QocRevision
from app.tables.recordings import Device, Recording, Trace
from app.tables.sessions import Controller, SessionSegment, StudySession
from app.tables.visits import Visit

out = sys.stdout.write
VISITS, PER_VISIT, STEPS = 20, 10, 300
CONTROLLERS = (Controller.CDBS, Controller.RL, Controller.CDBS, Controller.DISTILLED)
P1, P1_API = "/participants/P1/analyses", "/api/v1/participants/P1/analyses"
PAGES = (
    "/analyses", "/trial-time", "/analyses/results.svg", P1, f"{P1}/visits/rl", f"{P1}/models/rl", f"{P1}/paper", f"{P1}/energy",
    f"{P1}/beta", f"{P1}/evaluations", "/api/v1/analyses", P1_API, f"{P1_API}/primary",
)  # fmt: skip


def make_study(client: TestClient, visits: int) -> None:
    """Four participants with all their sessions, written straight to the store."""
    rng = np.random.default_rng(0)
    settings = {"xi_beta": 1.0, "cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"}
    for code in ("P1", "P2", "P3", "P4"):
        client.post("/api/v1/participants", json={"code": code, "settings": settings}).raise_for_status()
    with new_session() as db:
        set_actor(db, "benchmark")
        for code in ("P1", "P2", "P3", "P4"):
            participant = repository.participant_by_code(db, code, SYSTEM)
            device = Device(participant_id=participant.id, pseudonym="d", kind="table")
            rows = [Visit(participant_id=participant.id, number=v, date=date(2026, 1, 1) + timedelta(28 * v)) for v in range(1, visits + 1)]
            db.add_all([device, *rows])
            db.flush()
            for visit in rows:
                _fill(db, visit, device.id, rng)
        db.commit()
        db.execute(text("analyze"))
        db.commit()


def _fill(db: Session, visit: Visit, device_id: int, rng: np.random.Generator) -> None:
    """The sessions of a visit, each with a recording of its own."""
    day, duration_s = rng.normal(0, 0.3), 2.0 * STEPS
    sessions = [StudySession(visit_id=visit.id, ordinal=k + 1, duration_s=duration_s, status="confirmed") for k in range(PER_VISIT)]
    recordings = [
        Recording(participant_id=visit.participant_id, device_id=device_id, fingerprint=f"{visit.number}.{k}", clock="table",
                  duration_s=duration_s, details={})
        for k in range(PER_VISIT)
    ]  # fmt: skip
    for k, session in enumerate(sessions):
        blinding.assign(session, CONTROLLERS[k % len(CONTROLLERS)], None)
    db.add_all([*sessions, *recordings])
    db.flush()
    for k, (session, recording) in enumerate(zip(sessions, recordings, strict=True)):
        level = 1.0 if CONTROLLERS[k % len(CONTROLLERS)] is Controller.CDBS else 0.7
        for stream, unit, values in (
            ("beta", "uV", 2 + day + 0.2 * rng.random(STEPS)),
            ("amplitude", "fraction", level * (1 - 0.1 * rng.random(STEPS))),
        ):
            packed, valid = pack(values, np.ones(STEPS, dtype=bool))
            grid = {"dt_s": 2.0, "first_end_s": 2.0, "n": STEPS, "values_f32": packed, "valid_bits": valid}
            db.add(Trace(recording_id=recording.id, decode_version=1, stream=stream, unit=unit, source="table", **grid))
        outcomes = {
            "grasp_hz": 2.4 + day + 0.1 * rng.normal(),
            "rating": int(np.clip(round(7 + day + rng.normal()), 1, 10)),
            "tremor_percent": float(np.clip(12 + 3 * rng.normal(), 0, 100)),
        }
        db.add(SessionSegment(session_id=session.id, recording_id=recording.id, start_s=0.0, stop_s=duration_s))
        db.add(QocRevision(session_id=session.id, revision=1, entered_by="benchmark", **outcomes))


def milliseconds(client: TestClient, path: str, repeats: int, *, keep: bool) -> tuple[float, float]:
    """Medians of processor and wall time of a page, ms; the first request of all is not counted."""
    cpu, wall = [], []
    for _ in range(repeats + 1):
        if not keep:
            kept.forget()
        started, began = time.perf_counter(), time.process_time()
        client.get(path).raise_for_status()
        cpu.append(1000 * (time.process_time() - began))
        wall.append(1000 * (time.perf_counter() - started))
    return median(cpu[1:]), median(wall[1:])


def measure(visits: int, repeats: int) -> dict[str, dict[str, float]]:
    """The study, then every page; prints one line each."""
    migrate()
    with transaction("benchmark") as db:
        accounts.add_user(db, "bench@clinic.example", Role.ADMIN, "a password for benchmarks")
        token = accounts.create_token(db, "bench@clinic.example", "bench")
    found = {}
    with TestClient(create_app(), headers={"Authorization": f"Bearer {token}"}) as client:
        make_study(client, visits)
        leave_to_itself()
        out(f"{4 * visits * PER_VISIT} sessions, load average {os.getloadavg()[0]:.1f}; milliseconds\n")
        out(f"{'page':<40}{'uncached cpu':>13}{'wall':>7}{'cached cpu':>12}{'wall':>7}\n")
        for path in PAGES:
            (cold_cpu, cold), (warm_cpu, warm) = (milliseconds(client, path, repeats, keep=keep) for keep in (False, True))
            found[path] = {"uncached_cpu": cold_cpu, "uncached_wall": cold, "cached_cpu": warm_cpu, "cached_wall": warm}
            out(f"{path:<40}{cold_cpu:>13.0f}{cold:>7.0f}{warm_cpu:>12.0f}{warm:>7.0f}\n")
    return found


def main() -> None:
    """Measure, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--quick", action="store_true", help="four visits, two requests")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ.pop("BETALOOP_DATABASE_URL", None)
        os.environ["BETALOOP_DATA_DIR"] = folder
        get_settings.cache_clear()
        figures = measure(4 if asked.quick else VISITS, 2 if asked.quick else asked.repeats)
    if asked.json:
        asked.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
