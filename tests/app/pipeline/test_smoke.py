"""The whole loop once, as small as it can be: `make smoke`, the first thing to run after a change.

Upload, fit, ranking, plan, signature, bundle, a session on a simulated device, and its log back into its slot. All of it runs through the
service, its database, a worker in a process of its own, and `betaloop control`.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.tablet.command import control
from app.tablet.sources import Task, Wish

SETTINGS = {"design": "stratified", "cdbs_amplitude_ma": 3.0, "xi_beta": 1.0, "beta_unit": "uV", "beta_source": "table"}
WIDE = {"grasp_share": 0.5, "rating_points": 5, "tremor_points": 50, "unsafe_beyond": 0.9, "nearly_off_share": 0.9}
"""Margins within which a policy of sixty updates may be planned."""
SMALL = {"preset": "quick", "count": 1, "updates": 60, "distil_updates": 60, "methods": ["posterior"], "seed": 3}


@pytest.mark.slow
@pytest.mark.usefixtures("worker")
def test_from_a_recording_to_a_signed_controller_and_back_to_its_recording(
    client: TestClient,
    participant_code: str,
    upload: Callable[..., int],
    ended: Callable[..., dict[str, Any]],
    sign_plan: Callable[..., Any],
    tmp_path: Path,
) -> None:
    of_participant = f"/api/v1/participants/{participant_code}"
    assert client.put(f"{of_participant}/settings", json={"settings": SETTINGS}).status_code == 200
    stated = client.put(f"{of_participant}/margins", json={"margins": WIDE, "reason": "for this test"})
    assert stated.status_code == 200, stated.text
    for controller in ("random", "cdbs", "random", "random", "cdbs"):
        upload(controller, steps=150)

    done = ended(client.post(f"{of_participant}/jobs", json={"kind": "pipeline", **SMALL}).json()["id"], 300)
    assert done["status"] == "succeeded", done
    ranked = client.get(f"{of_participant}/ranking").json()["policies"]
    policy = next(p["policy_id"] for p in ranked if p["kind"] == "trained" and p["decision"])

    visit = client.post(f"{of_participant}/visits", json={"number": 2, "date": datetime.now(UTC).date().isoformat()}).json()["id"]
    drafted = client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": [policy], "minutes_per_session": 5, "seed": 1})
    assert drafted.status_code == 201, drafted.text
    signed = sign_plan(visit)
    assert signed.status_code == 200, signed.text
    position = next(s["position"] for s in signed.json()["sessions"] if s["policy_id"] == policy)

    bundle, log = tmp_path / "bundle.zip", tmp_path / "log.csv"
    taken = client.get(f"/api/v1/visits/{visit}/plan/sessions/{position}/bundle")
    assert taken.status_code == 200, taken.text
    bundle.write_bytes(taken.content)
    key = client.get("/api/v1/bundle-key").text.strip()
    task = Task(key=key, log=log, participant=participant_code, ledger=tmp_path / "ledger")
    ran = control(bundle, "simulated:P1:4", Wish(), task)
    assert ran["policy"] + ran["fallbacks"] == ran["decisions"] > 140
    assert ran["policy"] > ran["decisions"] / 2, "most decisions are the policy's own, whichever policy is ranked first"

    sent = client.post("/api/v1/uploads", data={"participant": participant_code}, files={"file": ("log.csv", log.read_bytes())})
    assert sent.status_code == 201, sent.text
    row = next(r for r in client.get(f"/api/v1/visits/{visit}/slots").json()["rows"] if r["position"] == position)
    trace = client.get(f"/api/v1/sessions/{row['session_id']}/trace").json()
    logged = sum(line[:1].isdigit() for line in log.read_text().splitlines())
    assert 140 < len([t for t in trace["t_s"] if t > 0]) <= logged
