"""Threads that write to an installation over its REST interface, remember what it acknowledged, and compare that with what it holds."""

from __future__ import annotations

import io
import random
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import httpx2 as httpx
import numpy as np

from app.learning.policies import constant_onnx

from .installation import PASSWORD, Installation, utc

PEOPLE = {"admin@clinic.example": "admin", "signer@clinic.example": "clinician"}
SETTINGS = {"xi_beta": 1.0, "cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"}
REPEAT_S = 0.3
ANSWER_S = 30.0
STEPS = 40
TRAIN = {"kind": "train", "preset": "quick", "algorithms": ["ddpg"], "count": 1, "updates": 300}
EVALUATE = {"kind": "evaluate", "preset": "quick", "methods": ["linear"]}
MOST_LIVE_JOBS = 2
ALLOWED = (503, 507)
"""Server errors that a caller may meet while processes die and disks fill: the same is sent again."""


@dataclass
class Acknowledged:
    """Writes that the service acknowledged.

    Attributes:
        uploads: number of the upload to its session. qocs: (session, grasp frequency), each frequency once. entries: of the clinic day.
        jobs: their ids. answers: how often each status came, and how often none ("cut off").
        faults: answers that are a fault of the service whatever was killed: server errors but 503 and 507.
    """

    uploads: dict[int, int] = field(default_factory=dict)
    qocs: list[tuple[int, float]] = field(default_factory=list)
    entries: list[str] = field(default_factory=list)
    jobs: list[str] = field(default_factory=list)
    answers: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return f"{len(self.uploads)} uploads, {len(self.qocs)} QoCs, {len(self.entries)} entries, {len(self.jobs)} jobs"


@dataclass(frozen=True)
class Study:
    """A participant that is written to, and one with sessions and a policy to train and evaluate on.

    Attributes:
        day: the visit with a signed plan. plan: that plan. session: one that QoCs are entered for. policy: of the second participant.
    """

    day: int
    plan: int
    session: int
    policy: int


def table(rng: np.random.Generator, steps: int = STEPS) -> bytes:
    """Write a session as a CSV that equals no other."""
    sink = io.StringIO()
    sink.write("t_s,beta,amplitude_fraction\n")
    for k in range(-10, steps):
        sink.write(f"{2 * (k + 1)},{rng.uniform(0.6, 1.9):.6f},{rng.uniform(0.3, 1.0):.4f}\n")
    return sink.getvalue().encode()


def make_study(installed: Installation, tokens: dict[str, str]) -> Study:
    """Make participants S1 (two visits, the second with a signed plan) and S2 (six sessions, a policy)."""
    rng = np.random.default_rng(1)
    # patiently: the first upload of a machine compiles what reads recordings
    admin, signer = (client(installed, tokens[address], 5 * ANSWER_S) for address in PEOPLE)
    for code in ("S1", "S2"):
        _must(admin.post("/participants", json={"code": code, "settings": SETTINGS}))
    visits = [_must(admin.post("/participants/S1/visits", json={"number": n}))["id"] for n in (1, 2)]
    _must(admin.post("/participants/S2/visits", json={"number": 1}))
    for controller in ("random", "cdbs", "random", "no_dbs", "random", "cdbs"):
        body = {"participant": "S2", "visit": "1", "controller": controller}
        sent = _must(admin.post("/uploads", data=body, files={"file": ("s.csv", table(rng, 60))}))
        _must(admin.put(f"/sessions/{sent['sessions'][0]['id']}/qoc", json={"grasp_hz": 2.0, "rating": 7, "tremor_percent": 10.0}))
    policy = _must(admin.post("/participants/S2/policies", data={"name": "steady"}, files={"file": ("s.onnx", constant_onnx(0.6, 10))}))
    _must(admin.post(f"/visits/{visits[1]}/plan", json={"policy_ids": [], "random_sessions": 1, "seed": 1}))
    _must(signer.post(f"/visits/{visits[1]}/plan/approve", json={"password": PASSWORD}))
    plan = _must(admin.get(f"/visits/{visits[1]}/day"))["plan_id"]
    first = _must(
        admin.post("/uploads", data={"participant": "S1", "visit": "1", "controller": "random"}, files={"file": ("f.csv", table(rng))})
    )
    return Study(visits[1], plan, first["sessions"][0]["id"], policy["id"])


def client(installed: Installation, token: str, patience_s: float = ANSWER_S) -> httpx.Client:
    """Make a caller of the REST interface."""
    return httpx.Client(base_url=f"{installed.bases[0]}/api/v1", headers={"Authorization": f"Bearer {token}"}, timeout=patience_s)


class Writers:
    """Four threads: uploads, QoCs, entries of a clinic day, jobs. Each sends the same again until it is acknowledged.

    Args:
        token: of a user who may write all of it.
        pause_s: between two writes of a thread.
    """

    def __init__(self, installed: Installation, token: str, study: Study, pause_s: float = 0.15) -> None:
        self.said = Acknowledged()
        self._installed, self._token, self._study, self._pause_s = installed, token, study, pause_s
        self._no_more, self._no_more_jobs, self._give_up = threading.Event(), threading.Event(), threading.Event()
        self._begins_a_job = threading.Lock()
        self._faults: list[BaseException] = []
        works = (self._uploads, self._qocs, self._entries, self._jobs)
        self._threads = [threading.Thread(target=self._work, args=(work,), name=work.__name__, daemon=True) for work in works]

    def start(self) -> None:
        """Begin to write."""
        for thread in self._threads:
            thread.start()

    def stop_jobs(self, seconds: float = 2 * ANSWER_S) -> None:
        """Begin no further job; a request for one that is on its way is answered first. Raises RuntimeError where it is not."""
        self._no_more_jobs.set()
        if not self._begins_a_job.acquire(timeout=seconds):
            raise RuntimeError(f"a request for a job was not answered within {seconds:.0f} s: {self.said.answers}")
        self._begins_a_job.release()

    def stop(self, seconds: float = 2 * ANSWER_S) -> None:
        """Let every thread bring its present write through, and end. Raises RuntimeError where one cannot."""
        self._no_more_jobs.set()
        self._no_more.set()
        deadline = time.monotonic() + seconds
        for thread in self._threads:
            thread.join(max(deadline - time.monotonic(), 0.1))
        late = [thread.name for thread in self._threads if thread.is_alive()]
        self._give_up.set()
        if late or self._faults:
            raise RuntimeError(
                f"writers did not end within {seconds:.0f} s: {late}; faults: {self._faults!r}; answers: {self.said.answers}"
            )

    def _work(self, work: Callable[[httpx.Client], None]) -> None:
        try:
            with client(self._installed, self._token) as caller:
                while not self._no_more.is_set():
                    # to one web after the other, as a proxy before several of them does
                    caller.base_url = f"{random.choice(self._installed.bases)}/api/v1"
                    work(caller)
                    self._no_more.wait(self._pause_s)
        except BaseException as fault:
            self._faults.append(fault)
            raise

    def _uploads(self, caller: httpx.Client) -> None:
        rng = np.random.default_rng()
        content = table(rng, 3000 if rng.random() < 0.1 else STEPS)
        body = {"participant": "S1", "visit": "1", "controller": "random"}
        got = self._until(lambda: caller.post("/uploads", data=body, files={"file": ("s.csv", content)}), (201,))
        if got and not got["sessions"]:
            raise RuntimeError(f"an upload was acknowledged without a session: {got}")
        if got:
            self.said.uploads[got["id"]] = got["sessions"][0]["id"]

    def _qocs(self, caller: httpx.Client) -> None:
        # a frequency that no other write has; what is not acknowledged is not sent again, for it may be there
        value = round(0.001 * (1 + len(self.said.qocs) + self.said.answers["QoC without answer"]), 3)
        body = {"grasp_hz": value, "rating": 7, "sure": ["grasp_hz"], "reason": "counted again"}
        answer = self._once(lambda: caller.put(f"/sessions/{self._study.session}/qoc", json=body))
        if answer is not None and answer.status_code == 200:
            self.said.qocs.append((self._study.session, value))
        else:
            self.said.answers["QoC without answer"] += 1

    def _entries(self, caller: httpx.Client) -> None:
        entry = {"uuid": str(uuid.uuid4()), "kind": "note", "payload": {"text": "tired"}, "device_time": utc().isoformat()}
        body = {"plan_id": self._study.plan, "entries": [entry]}
        got = self._until(lambda: caller.post(f"/visits/{self._study.day}/day/entries", json=body), (200,))
        if got:
            (result,) = got["results"]
            if result["outcome"] not in ("stored", "known"):
                raise RuntimeError(f"an entry of the clinic day was not taken: {result}")
            self.said.entries.append(entry["uuid"])

    def _jobs(self, caller: httpx.Client) -> None:
        with self._begins_a_job:
            if not self._no_more_jobs.is_set():
                self._begin_a_job(caller)

    def _begin_a_job(self, caller: httpx.Client) -> None:
        listed = self._once(lambda: caller.get("/participants/S2/jobs", params={"limit": 20}))
        if listed is None or listed.status_code != 200:
            return
        if sum(job["finished_at"] is None for job in listed.json()["items"]) < MOST_LIVE_JOBS:
            body = EVALUATE | {"policies": [self._study.policy]} if len(self.said.jobs) % 2 else TRAIN
            answer = self._once(lambda: caller.post("/participants/S2/jobs", json=body | {"again": True}))  # sent once: it may have begun
            if answer is not None and answer.status_code == 202:
                self.said.jobs.append(answer.json()["id"])

    def _once(self, send: Callable[[], httpx.Response]) -> httpx.Response | None:
        try:
            answer = send()
        except httpx.TransportError:
            self.said.answers["cut off"] += 1
            self._give_up.wait(REPEAT_S)
            return None
        self.said.answers[str(answer.status_code)] += 1
        if answer.is_server_error and answer.status_code not in ALLOWED:
            self.said.faults.append(f"{answer.request.method} {answer.request.url.path}: {answer.status_code} {answer.text[:300]}")
        return answer

    def _until(self, send: Callable[[], httpx.Response], right: tuple[int, ...]) -> Any:
        while not self._give_up.is_set():
            answer = self._once(send)
            if answer is not None and answer.status_code in right:
                return answer.json()
            if answer is not None and answer.status_code in (400, 401, 403, 404, 409):
                raise RuntimeError(f"a write was refused with {answer.status_code}: {answer.text[:500]}")
            self._give_up.wait(REPEAT_S)
        return None


def what_is_wrong(installed: Installation, said: Acknowledged, study: Study) -> list[str]:
    """List what was acknowledged and is absent or there twice, and server errors; empty where all is right."""
    wrong = [f"a request was answered with a server error: {fault}" for fault in said.faults]

    def rows(query: str, *values: Any) -> list[Any]:
        found = installed.ask(query, *values)
        if found is None:
            raise RuntimeError("the database does not answer at the end")
        return found

    stored = dict(rows("select id, status from upload where id = any(%s)", list(said.uploads)))
    wrong += [f"acknowledged upload {i} is {stored.get(i, 'gone')}" for i in said.uploads if stored.get(i) != "decoded"]
    sessions = {i for (i,) in rows("select id from session where status = 'confirmed'")}
    wrong += [f"session {s} of acknowledged upload {u} is gone" for u, s in said.uploads.items() if s not in sessions]
    twice = rows("select recording_id, count(*) from session_segment group by 1 having count(*) > 1")
    wrong += [f"recording {r} has {n} sessions" for r, n in twice]
    twice = rows("select original_sha256, count(*) from upload_file where status = 'decoded' group by 1 having count(*) > 1")
    wrong += [f"the bytes {h} are stored {n} times" for h, n in twice]
    shared = Counter(said.uploads.values())
    wrong += [f"session {s} was given to {n} uploads" for s, n in shared.items() if n > 1]
    values = Counter(rows("select session_id, grasp_hz from qoc where session_id = %s", study.session))
    wrong += [f"QoC {q} stands there {values[q]} times" for q in said.qocs if values[q] != 1]
    wrong += [f"QoC {q} was sent once and stands there {n} times" for q, n in values.items() if n > 1]
    entries = Counter(str(u) for (u,) in rows("select uuid from day_entry"))
    wrong += [f"entry {e} stands there {entries[e]} times" for e in said.entries if entries[e] != 1]
    ended = "kind = 'status' and data ->> 'status' in ('succeeded', 'failed', 'cancelled')"
    ends = dict(rows(f"select job_id, count(*) from job_event where {ended} group by 1"))
    known = {i for (i,) in rows("select id from job")}
    wrong += [f"acknowledged job {j} is gone" for j in said.jobs if j not in known]
    wrong += [f"job {j} ended {ends.get(j, 0)} times" for j in sorted(known) if ends.get(j, 0) != 1]
    return wrong


def live_jobs(installed: Installation) -> list[str] | None:
    """Describe the jobs that have not ended; None while the database does not answer."""
    found = installed.ask(
        "select j.id, j.kind, j.status, j.message, w.executor_id, w.status from job j left join dbos.workflow_status w"
        " on w.workflow_uuid = j.id where j.finished_at is null"
    )
    return None if found is None else [" ".join(map(str, row)) for row in found]


def _must(answer: httpx.Response) -> Any:
    if not answer.is_success:
        raise RuntimeError(f"{answer.request.method} {answer.request.url} answered {answer.status_code}: {answer.text[:500]}")
    return answer.json()
