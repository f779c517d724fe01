"""A job kind is one record: API, OpenAPI document, form, page and worker know one that is registered in a file of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from app.learning.trajectories import read_buffer

HERE = Path(__file__).parent
ROOT = HERE.parents[2]

SERVICE = """
import json, sys
import mean_beta_kind
from fastapi.testclient import TestClient
from app.main import create_app

with TestClient(create_app(), headers={"Authorization": "Bearer " + sys.argv[1]}, follow_redirects=False) as client:
    jobs = "/api/v1/participants/P1/jobs"
    by_form = client.post("/participants/P1/jobs", data={"kind": "mean_beta", "newest": "40"})
    by_api = client.post(jobs, json={"kind": "mean_beta", "newest": 0})
    schemas = client.get("/api/v1/openapi.json").json()["components"]["schemas"]
    print(json.dumps({
        "early": client.post("/api/v1/participants/P2/jobs", json={"kind": "mean_beta"}).json(),
        "by_form": [by_form.status_code, by_form.headers.get("location")],
        "by_api": [by_api.status_code, by_api.json()],
        "described": schemas["MeanBetaJob"]["properties"],
        "page": client.get("/participants/P1/jobs").text,
        "torch": "torch" in sys.modules,
    }))
"""


def run(code: str, *arguments: str) -> subprocess.Popen[str]:
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), str(ROOT)])}
    return subprocess.Popen([sys.executable, "-c", code, *arguments], cwd=ROOT, env=env, text=True, stdout=subprocess.PIPE)


@pytest.fixture
def worker(fresh_database: str) -> Any:
    process = run("import mean_beta_kind; mean_beta_kind.work()")
    yield process
    process.terminate()
    process.wait(300)


@pytest.mark.slow
def test_a_new_kind_is_one_registration(
    client: TestClient, upload: Callable[..., int], make_token: Callable[[str], str], worker: Any, ended: Any
) -> None:
    upload("random")
    assert client.post("/api/v1/participants", json={"code": "P2"}).status_code == 201
    assert client.post("/api/v1/participants/P1/jobs", json={"kind": "mean_beta"}).status_code == 422, "unknown in this process"
    service = run(SERVICE, make_token("engineer"))
    seen = json.loads(service.communicate(timeout=120)[0])
    assert service.returncode == 0
    assert seen["early"]["status"] == 422, "what the kind requires is asked for before it is queued"
    assert seen["by_api"][0] == 422, "its schema holds"
    assert set(seen["described"]) == {"kind", "newest", "again", "bulk"}
    assert '<option value="mean_beta">Mean beta amplitude</option>' in seen["page"]
    assert seen["torch"] is False
    status, location = seen["by_form"]
    assert status == 303
    job = ended(location.removeprefix("/jobs/").split("?")[0])
    assert (job["status"], job["kind"], job["params"]) == ("succeeded", "mean_beta", {"newest": 40}), job
    snapshot = client.get("/api/v1/participants/P1/snapshots").json()["items"][0]
    beta = np.concatenate([s.padded_beta for s in read_buffer(snapshot["file_sha256"]).sessions])
    assert job["result"]["mean"] == pytest.approx(float(np.nanmean(beta[-40:])))
