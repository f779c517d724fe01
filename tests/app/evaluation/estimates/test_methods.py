"""A method is one record: what is added here runs in a child process and appears in schema, ranking, jobs page and charts at once."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from pydantic import TypeAdapter, ValidationError
from sqlalchemy.orm import Session

from app.evaluation.estimates.compute import evaluate_method
from app.evaluation.schemas import EvaluateParams
from app.platform.jobs import StepReport
from app.platform.jobs.children.child import ChildLimits
from app.platform.jobs.children.forked import ForkedProcesses
from app.platform.jobs.children.supervisor import ONE_THREAD, ComputeCall
from ml.ope import registry
from ml.ope.estimate import Estimate
from ml.ope.registry import Method, Size
from ml.policies.policy import Policy
from ml.progress import silent
from ml.trajectories import ReplayBuffer
from tests.app.evaluation.estimates.test_compute import buffer_of, call, sessions
from tests.app.evaluations import estimate

MEAN = Method(
    key="mean_session", name="Mean of all sessions", short="Mean", family="value", needs="one session",
    factory=f"{__name__}:build", by_default=True, weight=0.5, colour="good", symbol="hourglass",
)  # fmt: skip


@dataclass(frozen=True)
class MeanOfSessions:
    """Says of every policy what all sessions returned on average."""

    method: str

    def fit(self, buffer: ReplayBuffer, report: Any = silent, checkpoint_dir: Path | None = None) -> FittedMean:
        return FittedMean(self.method, buffer)


@dataclass(frozen=True)
class FittedMean:
    method: str
    buffer: ReplayBuffer

    def evaluate(self, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Any = silent) -> dict[str, Estimate]:
        value = float(self.buffer.transitions().rewards.mean()) * (horizon_steps or 1)
        n = len(self.buffer.sessions)
        return {i: Estimate(self.method, value, value - 1, value + 1, 0.9, 0.6, value, None, {}, True, (), n) for i in policies}


def build(key: str, seed: int, size: Size) -> MeanOfSessions:
    return MeanOfSessions(key)


def evaluate_here(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Run `evaluate_method` in a child that knows the method of this file."""
    registry.register(MEAN)
    return evaluate_method(params, workdir, report)


@pytest.fixture
def registered() -> Iterator[None]:
    registry.register(MEAN)
    yield
    registry.unregister(MEAN.key)


def test_a_method_of_its_own_file_runs_in_a_child_process(db: Session, tmp_path: Path) -> None:
    db_call = call(db, buffer_of(sessions()), method=MEAN.key)
    db.commit()
    children = ForkedProcesses(learns=True)
    try:
        step = ComputeCall("evaluate_mean_session", f"{__name__}:evaluate_here", db_call, tmp_path / "step", ChildLimits(2048))
        outcome = children.run(step, lambda messages: None, lambda: None)
    finally:
        children.close()
    found = Estimate.from_json(outcome["result"]["estimates"]["7"])
    assert (found.method, found.n, found.supported) == (MEAN.key, 9, True)
    assert -1.3 * 50 < found.value < 0


def test_it_appears_in_the_schema_the_ranking_the_charts_and_the_jobs_page(
    registered: None, client: TestClient, policies: list[int], evaluate: Callable[..., int]
) -> None:
    assert MEAN.key in TypeAdapter(EvaluateParams).json_schema()["properties"]["methods"]["items"]["enum"]
    assert MEAN.key in EvaluateParams().methods
    other = {"estimates": {str(i): estimate(MEAN.key, 50.0 + k) for k, i in enumerate(policies)}}
    evaluate({i: estimate("dlsm", 10.0) for i in policies}, **{MEAN.key: other})
    body = client.get("/api/v1/participants/P1/ranking", params={"method": MEAN.key}).json()
    assert (body["default_method"], body["methods"]) == (MEAN.key, ["dlsm", MEAN.key])
    assert [p["policy_id"] for p in body["policies"]] == policies[::-1]
    page = client.get("/participants/P1/ranking").text
    assert all(text in page for text in (MEAN.name, MEAN.short, "hourglass", "token:good"))
    assert f'value="{MEAN.key}"' in client.get("/participants/P1/jobs").text


def test_without_a_record_its_estimates_stand_under_their_key(
    client: TestClient, policies: list[int], evaluate: Callable[..., int]
) -> None:
    gone = {"estimates": {str(i): estimate("gone", 50.0) for i in policies}}
    evaluate({i: estimate("dlsm", 10.0) for i in policies}, gone=gone)
    assert client.get("/api/v1/participants/P1/ranking").json()["methods"] == ["dlsm"]
    assert client.get("/participants/P1/ranking").status_code == 200
    assert registry.shown("gone").name == "gone"


def test_the_published_interface_lists_the_methods_and_refuses_others(client: TestClient) -> None:
    schemas = cast(FastAPI, client.app).openapi()["components"]["schemas"]
    assert schemas["EvaluateJob"]["properties"]["methods"]["items"]["enum"] == list(registry.method_keys())
    with pytest.raises(ValidationError, match="'nonsense' is no method of evaluation; choose among dlsm, dlsm_paper, linear"):
        EvaluateParams(methods=["nonsense", "fqe"])


LOADED = """
import sys, threading
from importlib import import_module
from pathlib import Path
for name in ("app.learning.training_compute", "app.evaluation.estimates.compute"):
    import_module(name).prepare()
assert {"torch._dynamo", "scipy.optimize", "numba.core.dispatcher"} <= set(sys.modules)
print([name for task in Path("/proc/self/task").iterdir() if (name := (task / "comm").read_text().strip()) != "jemalloc_bg_thd"])
"""


def test_the_process_whose_forks_compute_has_loaded_everything_and_has_one_thread() -> None:
    command = [sys.executable, "-c", LOADED]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=600, env=os.environ | ONE_THREAD)
    names = ast.literal_eval(done.stdout)
    assert len(names) == 1, "a fork of several threads may find a lock that nobody will release; jemalloc, of pyarrow, sees to its own"


def test_the_web_process_loads_no_torch() -> None:
    code = "import sys, app.main, app.pipeline.evaluation, app.evaluation.estimates.compute; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=300).returncode == 0
