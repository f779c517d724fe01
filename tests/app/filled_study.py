"""A study in use, made by the present version: four participants, sessions, two rankings, a tested policy, a cancelled job.

Jobs run their real steps in the process of the tests, with few updates: starting a child for each step would take most of the time.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from typing import Any

import torch
from fastapi.testclient import TestClient

from app.learning.policies import constant_onnx
from app.platform.jobs.children.forked import ForkedProcesses
from app.platform.jobs.children.report import StepReport
from app.platform.jobs.children.supervisor import ChildMessages, ComputeCall
from app.platform.jobs.context import StepOutcome
from app.platform.jobs.registry import load_compute
from app.platform.jobs.steps import JobRunner
from app.settings import private_folder
from app.simulation.demo.study import DAY, participant_body, session_file
from ml.designs import DesignedSession, DesignSettings, lay_out
from ml.population import run_session

Json = dict[str, Any]
PIPELINE = {"kind": "pipeline", "preset": "quick", "count": 1, "updates": 60, "distil_updates": 60, "methods": ["dlsm", "linear", "fqe"]}
"""Trains, distils and ranks; its policies need not be good."""
EVALUATION = {"kind": "evaluate", "preset": "quick", "methods": ["linear"]}
SESSIONS = {"P1": (4, 4), "P2": (4, 4), "P3": (2,), "P4": (4,)}
"""By participant, how many sessions each of the first visits has; everybody has four visits."""
STEPS = 60


class InThisProcess(ForkedProcesses):
    """Runs compute functions in this process."""

    def __init__(self) -> None:
        pass

    def run(self, call: ComputeCall, record: Callable[[ChildMessages], None], check: Callable[[], None]) -> StepOutcome:
        """Run one call and record its reports as they come."""

        def send(message: Json) -> None:
            messages = ChildMessages()
            messages.add(json.dumps(message))
            record(messages)

        check()
        torch.set_num_threads(1)
        report = StepReport(send)
        result = load_compute(call.reference)(call.params, private_folder(call.workdir), report)
        report.flush()
        return {"ok": True, "result": json.loads(json.dumps(result, allow_nan=False))}


class FilledStudy:
    """Fills an empty database over the REST interface.

    Args:
        admin: calls as an administrator.
    """

    def __init__(self, admin: TestClient) -> None:
        self._admin = admin
        self._runner = JobRunner("tests", 1)
        self._runner._children = InThisProcess()
        for code, counts in SESSIONS.items():
            self._enrol(code, counts)
        self._run("P1", PIPELINE)
        students = [p for p in self._read("/participants/P1/policies")["items"] if p["kind"] == "distilled"]
        self._upload("P1", 3, 0, "distilled", policy=students[0]["id"])
        for code in ("P2", "P4"):
            self._add_policies(code)
        self._run("P2", EVALUATION)
        cancelled = self._send("/participants/P4/jobs", json=PIPELINE)["id"]
        self._send(f"/jobs/{cancelled}/cancel")
        self._runner.run(cancelled)

    def _read(self, path: str) -> Any:
        answer = self._admin.get(f"/api/v1{path}")
        assert answer.status_code == 200, answer.text
        return answer.json()

    def _send(self, path: str, method: str = "post", **form: Any) -> Any:
        answer = self._admin.request(method, f"/api/v1{path}", **form)
        assert answer.is_success, answer.text
        return answer.json()

    def _enrol(self, code: str, counts: Sequence[int]) -> None:
        self._send("/participants", json=participant_body(code))
        designed = iter(lay_out(DesignSettings(visits=len(counts), sessions=DAY.count("random"), steps=STEPS, seed=0)))
        for number in range(1, 5):
            self._send(f"/participants/{code}/visits", json={"number": number, "date": self._begins(number).date().isoformat()})
            for ordinal, controller in enumerate(DAY[: counts[number - 1]] if number <= len(counts) else ()):
                self._upload(code, number, ordinal, controller, next(designed) if controller == "random" else None)

    def _begins(self, visit: int, ordinal: int = 0) -> datetime:
        """Return the start of a session: visits are four weeks apart, the fourth in two weeks; sessions twenty minutes."""
        today = datetime.now(UTC).replace(hour=9, minute=5, second=0, microsecond=0)
        return today + timedelta(days=14 - 28 * (4 - visit), minutes=20 * ordinal)

    def _upload(self, code: str, visit: int, ordinal: int, controller: str, design: DesignedSession | None = None, **more: Any) -> None:
        """Upload a simulated session with its outcomes; a random one with what its design drew."""
        begins = self._begins(visit, ordinal)
        driven: Any = controller if design is None else design.first_steps(STEPS)
        simulated = run_session(
            code, "cdbs" if controller == "distilled" else driven, visit=visit, seed=10 * visit + ordinal, steps=STEPS, lead_steps=10,
            resolution_ma=0.1,
        )  # fmt: skip
        fields = {"participant": code, "visit": visit, "controller": controller} | more
        if code == "P1":  # whose recordings are a device's, which does not say when its session began
            fields["started_at"] = begins.isoformat()
        file = session_file(f"{code}-{visit}-{ordinal}", simulated, begins)
        stored = self._send("/uploads", data=fields, files={"file": file})["sessions"][0]["id"]
        outcomes = {name: getattr(simulated.qoc, name) for name in ("grasp_hz", "rating", "tremor_percent")}
        self._send(f"/sessions/{stored}/qoc", "put", json=outcomes | {"sure": list(outcomes)})
        if design is not None:
            drawn = {"level": design.level, "holds": [asdict(d) for d in design.decisions]}
            stated = {"design": design.design, "seed": design.seed, "design_parameters": drawn, "reason": "laid out before the visit"}
            self._send(f"/sessions/{stored}/conditions", "put", json=stated)

    def _run(self, code: str, params: Json) -> None:
        """Run a job to its end."""
        job = self._send(f"/participants/{code}/jobs", json=params)["id"]
        self._runner.run(job)
        ended = self._read(f"/jobs/{job}")
        assert ended["status"] == "succeeded", ended

    def _add_policies(self, code: str) -> None:
        """Add two policies that were made elsewhere."""
        for level in (0.9, 0.95):
            made = {"file": (f"{level}.onnx", constant_onnx(level, 10))}
            self._send(f"/participants/{code}/policies", data={"name": f"constant {level}"}, files=made)
