"""Time that the server works for every page of a large study while a training runs, with bytes and queries.

    python benchmarks/pages.py --quick                     2 participants x 3 visits x 4 sessions x 8 policies, 5 requests of each page
    python benchmarks/pages.py                             20 participants x 12 visits x 8 sessions x 40 policies, 40 requests of each page
    python benchmarks/pages.py --only ranking,jobs         pages whose name holds one of these
    python benchmarks/pages.py --samples                   instead, one session of 1.2 million raw samples: 80 minutes at 250 Hz

The study is made once and kept in --data (var/benchmarks/pages); a worker trains on one of its participants meanwhile. Each request of a
page is of another participant, so that the first round finds nothing in the service's memory. Times are from the request to its last byte,
in this machine's clock, beside the processor time of service and client; bytes are those sent, compressed. The charts' library and styles,
which the browser keeps, are not counted. The first drawing of a session's samples, which decodes their file in a child and is kept from
then on, is told by itself (`first_signal_median_ms`, `first_signal_p95_ms`), with whether it meets a page's aim (`first_signal_meets_aim`).
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2 as httpx
import numpy as np
import uvicorn
from sqlalchemy import event, func, select, text
from support.large_study.entries import callers, complete
from support.large_study.raw_samples import raw_samples
from support.large_study.rows import EMAIL, PASSWORD, Extent, add_account, add_participant
from support.results import run_benchmark

from app.accounts.permissions import SYSTEM
from app.learning.repository import candidates
from app.main import create_app
from app.pipeline.service import start_job
from app.platform.database import get_engine, transaction
from app.platform.jobs.service import cancel
from app.platform.upkeep.migrate import migrate
from app.settings import get_settings
from app.study.repository import participant_by_code
from app.tables.jobs import Job
from app.tables.sessions import StudySession
from app.tables.visits import Visit

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "var" / "benchmarks" / "pages"
AIM_MEDIAN_MS, AIM_P95_MS = 150.0, 400.0
"""Of every page, on two cores that do nothing else."""

PAGES = {
    "sign-in": "/sign-in",
    "home": "/",
    "energy saved": "/energy-saved",
    "adverse events of all": "/adverse-events",
    "search": "/search?q=P0",
    "new participant": "/participants/new",
    "participant": "/participants/{code}",
    "visits": "/participants/{code}/visits",
    "new visit": "/participants/{code}/visits/new",
    "visit": "/visits/{visit}",
    "plan of a visit": "/visits/{visit}/plan",
    "approved plan": "/visits/{planned}/plan",
    "slots": "/visits/{planned}/slots",
    "bundles": "/visits/{planned}/bundles",
    "visit day": "/visit-day/{planned}",
    "session": "/sessions/{session}",
    "markers": "/sessions/{session}/markers",
    "signal": "/sessions/{signal}/signal",
    "signal's chart": "/sessions/{signal}/signal.json",
    "upload": "/participants/{code}/upload",
    "report": "/uploads/{upload}",
    "proposals": "/participants/{code}/proposals",
    "proposal": "/proposals/{proposal}",
    "quarantine": "/participants/{code}/quarantine",
    "mapping": "/uploaded-files/{file}/mapping",
    "column mappings": "/studies/main/column-mappings",
    "device history": "/participants/{code}/device-history",
    "settings": "/participants/{code}/settings",
    "characteristics": "/participants/{code}/characteristics",
    "margins": "/participants/{code}/margins",
    "adverse events": "/participants/{code}/adverse-events",
    "data queries": "/participants/{code}/data-queries",
    "policies": "/participants/{code}/policies",
    "policy": "/participants/{code}/policies/{policy}",
    "bundle": "/participants/{code}/policies/{policy}/bundle",
    "threshold rule": "/participants/{code}/policies/{policy}/threshold-rule",
    "buffer gate": "/participants/{code}/buffer-gate",
    "snapshot": "/snapshots/{snapshot}",
    "sweep": "/sweeps/{sweep}",
    "next generation": "/participants/{code}/next-generation",
    "ranking": "/participants/{code}/ranking",
    "compare": "/participants/{code}/compare?session={session}&policy={policy}&policy={other}",
    "calibration": "/participants/{code}/calibration",
    "analyses": "/participants/{code}/analyses",
    "analysis by visit": "/participants/{code}/analyses/visits/rl",
    "models": "/participants/{code}/analyses/models/rl",
    "paper": "/participants/{code}/analyses/paper",
    "energy": "/participants/{code}/analyses/energy",
    "beta": "/participants/{code}/analyses/beta",
    "evaluations": "/participants/{code}/analyses/evaluations",
    "plans": "/participants/{code}/plans",
    "jobs": "/participants/{code}/jobs",
    "job": "/jobs/{job}",
    "all jobs": "/jobs",
    "all participants": "/analyses",
    "trial time": "/trial-time",
    "audit": "/audit",
    "account": "/account",
    "accounts": "/accounts",
    "studies": "/studies",
    "glossary": "/glossary",
    "interface": "/api-reference",
    "style guide": "/styleguide",
}
"""Every page of the service (`tests/benchmarks/test_pages.py`), by what it is called in the table."""


@dataclass
class Counter:
    """Queries of the service since it was set back."""

    queries: int = 0


@dataclass
class Measured:
    """Requests of one page: milliseconds by this machine's clock and of the processor, bytes sent, queries."""

    wall_ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    size: list[int] = field(default_factory=list)
    queries: list[int] = field(default_factory=list)


def prepare(folder: Path, extent: Extent) -> None:
    """Make the study in a data folder, participant by participant; an interrupted one is continued."""
    os.environ["BETALOOP_DATA_DIR"] = str(folder)
    os.environ["BETALOOP_DEVELOPMENT"] = "true"  # the style guide is a page of developers
    get_settings.cache_clear()
    migrate()
    done = folder / "study.json"
    made: list[int] = json.loads(done.read_text()) if done.exists() else []
    for number in range(0, extent.participants + 1):
        if number in made:
            continue
        started = time.monotonic()
        with transaction("bench") as db:
            add_participant(db, number, extent) if number else add_account(db)
        made.append(number)
        done.write_text(json.dumps(made))
        print(f"made {number} of {extent.participants} in {time.monotonic() - started:.0f} s", flush=True)
    _enter(folder, extent)
    with transaction("bench") as db:
        db.execute(text("analyze"))


def _enter(folder: Path, extent: Extent) -> None:
    """Enter what the interface takes, for each participant once; `entered.json` has its identifiers."""
    done = folder / "entered.json"
    entered: dict[str, dict[str, Any]] = json.loads(done.read_text()) if done.exists() else {}
    codes = [f"P{number:02d}" for number in range(1, extent.participants + 1)]
    if all(code in entered for code in codes):
        return
    signer, drafter = callers(create_app(), EMAIL)
    for code in codes:
        if code in entered:
            continue
        started = time.monotonic()
        with transaction("bench") as db:
            policies = [p.id for p in candidates(db, participant_by_code(db, code, SYSTEM).id)[:2]]
        entered[code] = complete(signer, drafter, code, PASSWORD, extent.visits, policies)
        done.write_text(json.dumps(entered))
        print(f"entered what {code} brings in {time.monotonic() - started:.0f} s", flush=True)


def addresses(folder: Path, extent: Extent) -> list[dict[str, Any]]:
    """Find the identifiers in paths, for each participant: its newest visit with sessions, one of its sessions, policies, jobs, uploads."""
    found = []
    entered = json.loads((folder / "entered.json").read_text())
    with transaction("bench") as db:
        for number in range(1, extent.participants + 1):
            participant = participant_by_code(db, f"P{number:02d}", SYSTEM)
            visit = next(v for v in participant.visits if v.number == extent.visits)
            names = {"policy": "select max(id) from policy where kind = 'trained'", "job": "select min(id) from job where kind = 'train'"}
            names |= {"other": "select min(id) from policy where kind = 'trained'"}
            names |= {"snapshot": "select max(id) from buffer_snapshot where true", "sweep": "select max(id) from sweep where true"}
            rows = {k: db.scalar(text(f"{q} and participant_id = {participant.id}")) for k, q in names.items()}
            session = db.scalar(select(func.min(StudySession.id)).join(Visit).where(Visit.id == visit.id))
            found.append({"code": participant.code, "visit": visit.id, "session": session, **rows, **entered[participant.code]})
    return found


@contextmanager
def training() -> Iterator[None]:
    """Run a worker that trains on the first participant for longer than any measurement."""
    with transaction("bench") as db:
        participant = participant_by_code(db, "P01", SYSTEM)
        params = {"preset": "full", "count": 24, "updates": 1_000_000, "algorithms": ["ddpg"]}
        job = start_job(db, participant, "train", params, SYSTEM).job
    log = get_settings().data_dir / "worker.log"
    with log.open("ab") as out:
        worker = subprocess.Popen([sys.executable, "-m", "app.cli", "worker"], stdout=out, stderr=out, cwd=ROOT)
    try:
        _wait_for_progress(job.id)
        yield
    finally:
        with transaction("bench") as db:
            cancel(db, db.get_one(Job, job.id), "bench")
        time.sleep(3)
        worker.terminate()
        try:
            worker.wait(120)
        except subprocess.TimeoutExpired:  # on a machine that is busy with other work; its study is done with
            worker.kill()
            worker.wait()


def _wait_for_progress(job_id: str) -> None:
    for _ in range(240):
        with transaction("bench") as db:
            if db.get_one(Job, job_id).progress > 0:
                return
        time.sleep(0.5)
    raise SystemExit("the training did not start within two minutes: see worker.log in the data folder")


@contextmanager
def service() -> Iterator[tuple[str, Counter]]:
    """Run the web service in a thread of this process, whose queries are counted."""
    counter = Counter()

    def count(*_: object) -> None:
        counter.queries += 1

    event.listen(get_engine(), "before_cursor_execute", count)
    server = uvicorn.Server(uvicorn.Config(create_app(), host="127.0.0.1", port=0, log_level="error"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.05)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}", counter
    finally:
        server.should_exit = True
        thread.join(30)


def _browser(base: str) -> httpx.Client:
    return httpx.Client(base_url=base, headers={"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}, timeout=60)


def measure(base: str, counter: Counter, places: list[dict[str, Any]], names: list[str], requests: int) -> dict[str, Measured]:
    """Request every page `requests` times, participant after participant."""
    found = {name: Measured() for name in names}
    with _browser(base) as client, _browser(base) as nobody:
        if client.post("/sign-in", data={"email": EMAIL, "password": PASSWORD}).status_code != 303:
            raise SystemExit("nobody could sign in")
        client.get("/")  # templates are compiled once in the life of a service
        if "signal" in names:
            found["signal, first"] = Measured(first_looks(client, places))
        for name in names:
            client.get(PAGES[name].format(**places[0]))
        for i in range(requests):
            for name in names:
                place = places[(1 + i) % len(places)]
                counter.queries = 0
                cpu, wall = time.process_time(), time.perf_counter()
                who = nobody if name == "sign-in" else client
                with who.stream("GET", PAGES[name].format(**place)) as answer:
                    body = b"".join(answer.iter_raw())
                found[name].wall_ms.append(1000 * (time.perf_counter() - wall))
                found[name].cpu_ms.append(1000 * (time.process_time() - cpu))
                if answer.status_code != 200:
                    raise SystemExit(f"{PAGES[name].format(**place)} answered {answer.status_code}")
                found[name].size.append(len(body))
                found[name].queries.append(counter.queries)
    return found


def first_looks(client: httpx.Client, places: list[dict[str, Any]]) -> list[float]:
    """Measure milliseconds until the samples of sessions are drawn for the first time, which decodes their files in a child."""
    shutil.rmtree(get_settings().data_dir / "cache" / "signals", ignore_errors=True)
    found = []
    for place in places:
        wall = time.perf_counter()
        client.get(PAGES["signal"].format(**place)).raise_for_status()
        found.append(1000 * (time.perf_counter() - wall))
    return found


def report(found: dict[str, Measured]) -> dict[str, float | bool]:
    """Print the table; return the figures of the worst pages, and those of the first drawing of samples with whether they meet the aim."""
    first = found.pop("signal, first", None)
    print(f"{'page':<18}{'median ms':>10}{'p95 ms':>9}{'cpu ms':>9}{'kB':>8}{'queries':>9}")
    rows = []
    for name, m in found.items():
        median, p95 = float(np.median(m.wall_ms)), float(np.percentile(m.wall_ms, 95))
        rows.append((median, p95, max(m.size) / 1000))
        print(f"{name:<18}{median:>10.0f}{p95:>9.0f}{np.median(m.cpu_ms):>9.0f}{max(m.size) / 1000:>8.1f}{max(m.queries):>9}")
    medians, p95s, sizes = zip(*rows, strict=True)
    figures: dict[str, float | bool] = {
        "worst_median_ms": round(max(medians), 1), "worst_p95_ms": round(max(p95s), 1), "largest_kb": round(max(sizes), 1),
    }  # fmt: skip
    if first is None:
        return figures
    median, p95 = float(np.median(first.wall_ms)), float(np.percentile(first.wall_ms, 95))
    meets = median <= AIM_MEDIAN_MS and p95 <= AIM_P95_MS
    aim = f"the aim of {AIM_MEDIAN_MS:.0f} and {AIM_P95_MS:.0f} ms"
    print(f"{'signal, first':<18}{median:>10.0f}{p95:>9.0f}  {'meets' if meets else 'misses'} {aim}; not among the worst below")
    return figures | {"first_signal_median_ms": round(median, 1), "first_signal_p95_ms": round(p95, 1), "first_signal_meets_aim": meets}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small study in a folder that is removed")
    parser.add_argument("--data", type=Path, default=KEPT, help="where the study is kept")
    parser.add_argument("--only", default="", help="parts of names of pages, with commas")
    parser.add_argument("--requests", type=int, help="of each page")
    parser.add_argument("--idle", action="store_true", help="without a training")
    parser.add_argument("--samples", action="store_true", help="instead of pages, stretches of a session of many raw samples")
    options = parser.parse_args()
    if options.samples:
        print(json.dumps(raw_samples(*((60_000, 12) if options.quick else (1_200_000, 60)))))
        return
    names = [n for n in PAGES if not options.only or any(part in n for part in options.only.split(","))]
    extent = Extent(2, 3, 4, 8) if options.quick else Extent()
    with tempfile.TemporaryDirectory(prefix="betaloop-pages-") as scratch:
        folder = Path(scratch) if options.quick else options.data
        prepare(folder / extent.name, extent)
        places = addresses(folder / extent.name, extent)
        with service() as (base, counter):
            if options.idle:
                found = measure(base, counter, places, names, options.requests or (5 if options.quick else 40))
            else:
                with training():
                    found = measure(base, counter, places, names, options.requests or (5 if options.quick else 40))
    print(json.dumps(report(found)))


if __name__ == "__main__":
    run_benchmark(main)
