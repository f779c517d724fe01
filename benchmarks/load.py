"""Fifty people at their browsers and ten uploaders at once, while a worker trains: errors, lost writes, and how long answers take.

    python benchmarks/load.py                              50 people and 10 uploaders for 5 minutes
    python benchmarks/load.py --minutes 2
    python benchmarks/load.py --quick                      5 people and 2 uploaders for 20 seconds

Of an installation of its own, in a new folder, with its embedded PostgreSQL, web and worker as processes; the callers are in this
process, on the same cores. Each person signs in, then opens a page of the study or enters a QoC (one act in five), every 5 s on average,
by chance. Each uploader sends a session that no other is equal to, waits for the answer, and 10 s more. Times are from the request to
the last byte of the answer, by this machine's clock. At the end every acknowledged write must be there once, and 95 of 100 answers must
have come within 1 s on a machine that has nothing else to do, and within as many times as long as others take its processors; exit code 1
where not, or where a request failed.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field

import httpx2 as httpx
import numpy as np
from installed.installation import PASSWORD, STARTED_S, Installation, installation, times_slower
from installed.writers import PEOPLE, Acknowledged, Study, client, make_study, table, what_is_wrong
from support.results import run_benchmark

BETWEEN_PAGES_S, BETWEEN_UPLOADS_S = 5.0, 10.0
P95_S = 1.0
"""Of 95 of 100 answers, on a machine that has nothing else to do."""
OWN_LOAD = 3.0
"""Load that a measurement makes by itself (docs/reliability.md)."""
PAGES = {
    "today": "/",
    "participant": "/participants/S2",
    "visits": "/participants/S1/visits",
    "session": "/sessions/{session}",
    "ranking": "/participants/S2/ranking",
    "policies": "/participants/S2/policies",
    "jobs": "/jobs",
    "analyses": "/participants/S2/analyses",
    "upload page": "/participants/S1/upload",
}
TRAIN = {"kind": "train", "preset": "full", "algorithms": ["ddpg"], "count": 24, "updates": 1_000_000}


@dataclass
class Found:
    """Answers that callers met.

    Attributes:
        seconds: times of answers by what was asked for. wrong: answers that were not right, and how often.
    """

    said: Acknowledged = field(default_factory=Acknowledged)
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    wrong: Counter[str] = field(default_factory=Counter)

    async def timed(self, name: str, request: httpx.Request, caller: httpx.AsyncClient, right: int) -> httpx.Response | None:
        """Send a request and keep its time; None where the answer was not right."""
        begun = time.monotonic()
        try:
            answer = await caller.send(request)
        except httpx.HTTPError as error:
            self.wrong[f"{name}: {type(error).__name__}"] += 1
            return None
        self.seconds[name].append(time.monotonic() - begun)
        if answer.status_code == right:
            return answer
        self.wrong[f"{name}: {answer.status_code} {answer.text[:200] if answer.status_code != 303 else ''}"] += 1
        return None


async def person(number: int, base: str, study: Study, found: Found, until: float) -> None:
    """Simulate a person who signs in, looks at pages and enters QoCs."""
    rng = np.random.default_rng(number)
    headers = {"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}
    async with httpx.AsyncClient(base_url=base, headers=headers, timeout=60) as caller:
        await asyncio.sleep(rng.uniform(0, BETWEEN_PAGES_S))
        form = {"email": address(number), "password": PASSWORD}
        if await found.timed("sign in", caller.build_request("POST", "/sign-in", data=form), caller, 303) is None:
            return
        acts = 0
        while (pause := rng.exponential(BETWEEN_PAGES_S)) + time.monotonic() < until:
            await asyncio.sleep(pause)
            acts += 1
            if rng.random() < 0.2:
                value = round(0.001 * (number * 300 + acts), 3)  # no other write has it
                body = {"grasp_hz": value, "rating": 7, "sure": ["grasp_hz"], "reason": "counted again"}
                request = caller.build_request("PUT", f"/api/v1/sessions/{study.session}/qoc", json=body)
                if await found.timed("QoC", request, caller, 200) is not None:
                    found.said.qocs.append((study.session, value))
            else:
                name = str(rng.choice(list(PAGES)))
                await found.timed(name, caller.build_request("GET", PAGES[name].format(session=study.session)), caller, 200)


async def uploader(number: int, base: str, token: str, found: Found, until: float) -> None:
    """Simulate a sender of sessions."""
    rng = np.random.default_rng(10_000 + number)
    async with httpx.AsyncClient(base_url=base, headers={"Authorization": f"Bearer {token}"}, timeout=60) as caller:
        await asyncio.sleep(rng.uniform(0, BETWEEN_UPLOADS_S))
        while time.monotonic() < until:
            stated = {"participant": "S1", "visit": "1", "controller": "random"}
            sent = caller.build_request("POST", "/api/v1/uploads", data=stated, files={"file": ("s.csv", table(rng, 300))})
            answer = await found.timed("upload", sent, caller, 201)
            if answer is not None:
                found.said.uploads[answer.json()["id"]] = answer.json()["sessions"][0]["id"]
            await asyncio.sleep(BETWEEN_UPLOADS_S)


def address(number: int) -> str:
    """Name the address of a person."""
    return f"person{number}@clinic.example"


async def everybody(installed: Installation, token: str, study: Study, people: int, uploaders: int, seconds: float) -> Found:
    """Run all callers at once; return what they met."""
    found, until = Found(), time.monotonic() + seconds
    callers = [person(i, installed.bases[0], study, found, until) for i in range(people)]
    callers += [uploader(i, installed.bases[0], token, found, until) for i in range(uploaders)]
    await asyncio.gather(*callers)
    return found


def load(people: int, uploaders: int, minutes: float) -> dict[str, float]:
    """Run once; print the table, and return the figures of the last line.

    Raises:
        RuntimeError: a request failed, something acknowledged is lost or doubled, or answers took too long.
    """
    with installation() as installed:
        tokens = installed.add_people(PEOPLE | {address(i): "engineer" for i in range(people)})
        token = tokens[next(iter(PEOPLE))]
        installed.start("web 1")
        installed.wait_until("the first answer of web", installed.webs_are_ready, STARTED_S)
        study = make_study(installed, tokens)
        installed.start("worker 1")
        with client(installed, token) as caller:
            job = caller.post("/participants/S2/jobs", json=TRAIN).json()["id"]
            progress = lambda: caller.get(f"/jobs/{job}").json()["progress"] > 0  # noqa: E731
            installed.wait_until("the training to begin", progress, STARTED_S, 0.5)
            found = asyncio.run(everybody(installed, token, study, people, uploaders, 60 * minutes))
            at_end = caller.get(f"/jobs/{job}").json()
            caller.post(f"/jobs/{job}/cancel")
            installed.wait_until("the cancelled training to end", lambda: caller.get(f"/jobs/{job}").json()["finished_at"], 30.0, 0.5)
        wrong = [f"{what} ({n} times)" for what, n in found.wrong.items()] + what_is_wrong(installed, found.said, study)
        if at_end["status"] != "running":
            wrong.append(f"the training did not run to the end of the measurement: {at_end['status']}, {at_end['error']}")
        installed.stop()
    figures = report(found, load_average=os.getloadavg()[1 if minutes >= 3 else 0])
    wrong += too_slow(figures)
    if wrong:
        raise RuntimeError(f"{len(wrong)} things are wrong:\n" + "\n".join(wrong[:40]))
    return figures


def too_slow(figures: dict[str, float]) -> list[str]:
    """List a sentence where answers took longer than the load of the machine allows."""
    if figures["p95_share"] < 1:
        return []
    return [f"95 of 100 answers came within {figures['p95_s']} s at a load of {figures['load']}: the aim is {P95_S:.0f} s"]


def report(found: Found, load_average: float) -> dict[str, float]:
    """Print times by what was asked for; the figures of all together. `load_average` is of the time of the measurement."""
    print(f"{'what':<14}{'answers':>8}{'median s':>10}{'p95 s':>8}{'longest s':>11}")
    for name, times in sorted(found.seconds.items()):
        print(f"{name:<14}{len(times):>8}{np.median(times):>10.3f}{np.percentile(times, 95):>8.3f}{max(times):>11.3f}")
    every = [s for times in found.seconds.values() for s in times]
    p95 = float(np.percentile(every, 95))
    return {
        "answers": len(every), "errors": sum(found.wrong.values()), "acknowledged_writes": len(found.said.uploads) + len(found.said.qocs),
        "median_s": round(float(np.median(every)), 3), "p95_s": round(p95, 3),
        "p95_share": round(p95 / (P95_S * times_slower(load_average, OWN_LOAD)), 3),
        "longest_s": round(max(every), 3), "load": round(load_average, 1),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="5 people and 2 uploaders for 20 seconds")
    parser.add_argument("--people", type=int, default=50)
    parser.add_argument("--uploaders", type=int, default=10)
    parser.add_argument("--minutes", type=float, default=5.0)
    options = parser.parse_args()
    people, uploaders, minutes = (5, 2, 1 / 3) if options.quick else (options.people, options.uploaders, options.minutes)
    try:
        figures = load(people, uploaders, minutes)
    except RuntimeError as wrong:
        print(f"load: {wrong}", file=sys.stderr)
        sys.exit(1)
    print(json.dumps(figures))


if __name__ == "__main__":
    run_benchmark(main)
