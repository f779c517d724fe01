"""How long jobs take where they are used: in a whole installation, sent and watched over its REST interface.

    python -m benchmarks.development.jobs                one evaluation of 40 sessions and 12 policies, default methods
    python -m benchmarks.development.jobs --workers 3    12 jobs, trainings and evaluations in turns, with three workers: jobs per hour
    python -m benchmarks.development.jobs --quick        9 sessions and 3 policies

The sessions are those of a virtual patient of part A by the stratified design; policies are constants and proportional controllers. Wall
time is from the answer to the job's request to the moment at which the job says it has ended; `cores_used` is the time in which the
machine's cores were not idle over that time, of whatever ran on it, so run it on a quiet machine. The single evaluation also prints how
long each of its steps took.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import time
from datetime import datetime
from typing import Any

import httpx2 as httpx
import psutil

from app.learning.policies.baselines import constant_onnx, proportional_onnx
from benchmarks.installed.installation import STARTED_S, Installation, installation
from benchmarks.installed.writers import ANSWER_S, PEOPLE, client
from ml.policies.policy import ProportionalPolicy
from ml.population.virtual import World, world
from ml.trajectories import SessionTrajectory

CODE, WORLD = "J1", 0
SESSIONS, POLICIES, VISITS = 40, 12, 6
QUICK_SESSIONS, QUICK_POLICIES = 9, 3
JOBS = 12
LONGEST_S = 3600.0
TRAIN = {"kind": "train", "preset": "quick", "algorithms": ["ddpg"], "count": 1, "updates": 2000}
EVALUATE = {"kind": "evaluate", "preset": "quick", "methods": ["posterior", "linear"]}


def filled(installed: Installation, token: str, sessions: int, policies: int) -> httpx.Client:
    """A caller of an installation that holds one participant with so many sessions and policies."""
    caller, w = client(installed, token, 5 * ANSWER_S), world("A", WORLD)
    s = w.settings
    settings = {"xi_beta": s.xi_beta, "cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"}
    _must(caller.post("/participants", json={"code": CODE, "settings": settings}))
    rows = w.data("stratified", visits=VISITS).sessions[:sessions]
    for number in sorted({row.visit for row in rows}):
        _must(caller.post(f"/participants/{CODE}/visits", json={"number": number}))
    for row in rows:
        body = {"participant": CODE, "visit": str(row.visit), "controller": row.controller}
        sent = _must(caller.post("/uploads", data=body, files={"file": (f"{row.session_id}.csv", table(row, s.period_s))}))
        qoc = {
            "grasp_hz": round(row.qoc.grasp_hz or 0.0, 3),
            "rating": row.qoc.rating,
            "tremor_percent": round(row.qoc.tremor_percent or 0.0, 2),
        }
        _must(caller.put(f"/sessions/{sent['sessions'][0]['id']}/qoc", json=qoc))
    for name, content in list(files(w).items())[:policies]:
        _must(caller.post(f"/participants/{CODE}/policies", data={"name": name}, files={"file": (f"{name}.onnx", content)}))
    return caller


def table(row: SessionTrajectory, period_s: float) -> bytes:
    """A session as the CSV that a coordinator uploads, with the beta before its first step."""
    sink = io.StringIO()
    sink.write("t_s,beta,amplitude_fraction\n")
    lead = len(row.lead_beta)
    for k, value in enumerate(row.lead_beta):
        sink.write(f"{period_s * (k - lead + 1):g},{value:.6f},1.0\n")
    for k, (value, amplitude) in enumerate(zip(row.beta, row.amplitude, strict=True)):
        sink.write(f"{period_s * (k + 1):g},{value:.6f},{amplitude:.4f}\n")
    return sink.getvalue().encode()


def files(w: World) -> dict[str, bytes]:
    """Twelve policies, constants and proportional controllers in turns."""
    window, xi, spread = w.settings.window, w.settings.xi_beta, w.spread
    made = {}
    for i in range(POLICIES // 2):
        made[f"steady-{i}"] = constant_onnx(0.45 + 0.09 * i, window)
        follows = ProportionalPolicy(low=xi - spread, high=xi + (0.5 + 0.4 * i) * spread, floor=0.3 + 0.08 * i, newest=1 + i)
        made[f"follows-{i}"] = proportional_onnx(follows, window)
    return made


def run_jobs(installed: Installation, caller: httpx.Client, bodies: list[dict[str, Any]]) -> dict[str, float]:
    """Send jobs together and wait for all; wall seconds, jobs per hour, cores used. Raises RuntimeError where one does not succeed."""
    begun, idle = time.monotonic(), psutil.cpu_times()
    ids = [_must(caller.post(f"/participants/{CODE}/jobs", json=body | {"again": True}))["id"] for body in bodies]
    left = set(ids)

    def all_ended() -> bool:
        for job in sorted(left):
            found = _must(caller.get(f"/jobs/{job}"))
            if found["finished_at"] is not None:
                if found["status"] != "succeeded":
                    raise RuntimeError(f"job {job} ended as {found['status']}: {found}")
                left.discard(job)
        return not left

    # a look takes some milliseconds of the processor for each job
    installed.wait_until("the jobs' end", all_ended, LONGEST_S, every_s=0.5 if len(ids) == 1 else 5.0)
    wall = time.monotonic() - begun
    after = psutil.cpu_times()
    idle_s = (after.idle + after.iowait) - (idle.idle + idle.iowait)
    cores = os.cpu_count() or 1
    return {"wall_s": round(wall, 1), "jobs_per_hour": round(3600 * len(ids) / wall, 1), "cores_used": round(cores - idle_s / wall, 2)}


def seconds_of_steps(caller: httpx.Client) -> dict[str, float]:
    """Wall seconds of each step of the newest job; steps run side by side, as many as there are cores, and share them."""
    newest = _must(caller.get(f"/participants/{CODE}/jobs"))["items"][0]["id"]
    return {
        step["key"]: (datetime.fromisoformat(step["finished_at"]) - datetime.fromisoformat(step["started_at"])).total_seconds()
        for step in _must(caller.get(f"/jobs/{newest}"))["steps"]
        if step["started_at"] and step["finished_at"]
    }


def _must(answer: httpx.Response) -> Any:
    if answer.status_code >= 400:
        raise RuntimeError(f"{answer.request.method} {answer.request.url}: {answer.status_code} {answer.text[:500]}")
    return answer.json()


def main() -> None:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_SESSIONS} sessions, {QUICK_POLICIES} policies")
    parser.add_argument("--workers", type=int, help=f"{JOBS} jobs with so many workers instead of one evaluation")
    chosen = parser.parse_args()
    sessions, policies = (QUICK_SESSIONS, QUICK_POLICIES) if chosen.quick else (SESSIONS, POLICIES)
    steps: dict[str, float] = {}
    with installation(workers=chosen.workers or 1) as installed:
        tokens = installed.add_people(PEOPLE)
        for name in (*installed.webs, *installed.workers):
            installed.start(name)
        installed.wait_until("the web", installed.webs_are_ready, STARTED_S)
        caller = filled(installed, tokens[next(iter(PEOPLE))], sessions, policies)
        # a first job starts what computes and compiles; it is not counted
        run_jobs(installed, caller, [EVALUATE])
        if chosen.workers is None:
            figures = run_jobs(installed, caller, [{"kind": "evaluate"}])
            steps = seconds_of_steps(caller)
        else:
            figures = run_jobs(installed, caller, [TRAIN if i % 2 else EVALUATE for i in range(JOBS // 6 if chosen.quick else JOBS)])
    figures |= {"sessions": sessions, "policies": policies, "workers": chosen.workers or 1, "load_before": round(os.getloadavg()[0], 1)}
    for key, seconds in sorted(steps.items(), key=lambda item: -item[1]):
        print(f"{key:24}{seconds:8.1f} s")
    print(json.dumps({"name": "jobs", "figures": figures}))


if __name__ == "__main__":
    main()
