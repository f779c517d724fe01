"""The interface gives every trace of a session, whatever its controller saw."""

from __future__ import annotations

import numpy as np
from fastapi.testclient import TestClient

from tests.app.ingest.conftest import device_zip


def test_every_channel_power_and_amplitude_of_a_session_is_given_on_its_own_rows(client: TestClient, participant_code: str) -> None:
    client.put(f"/api/v1/participants/{participant_code}/settings", json={"settings": {"cdbs_amplitude_ma": 4.0}})
    data = {"participant": participant_code, "visit": "1", "controller": "random"}
    answer = client.post("/api/v1/uploads", data=data, files={"file": ("a.zip", device_zip())})
    session = answer.json()["sessions"][0]["id"]
    traces = client.get(f"/api/v1/sessions/{session}/traces").json()
    kinds = {(t["stream"], t["unit"]) for t in traces}
    assert {("beta", "uV"), ("beta_power", "uV2"), ("band_power", "device units"), ("amplitude", "mA")} <= kinds
    assert all(len(t["t_s"]) == len(t["values"]) > 0 for t in traces)
    assert {t["hemisphere"] for t in traces} == {"right"}
    shown = client.get(f"/api/v1/sessions/{session}/trace").json()
    (control,) = [t for t in traces if t["is_control"]]
    assert control["channel"] == shown["beta_channel"]
    inside = {t: v for t, v in zip(control["t_s"], control["values"], strict=True) if t > 0 and v is not None}
    grid = {t: v for t, v in zip(shown["t_s"], shown["beta"], strict=True) if t > 0 and v is not None}
    np.testing.assert_allclose([*inside.values()], [*grid.values()])
    amplitude = next(t for t in traces if t["stream"] == "amplitude")
    assert max(v for v in amplitude["values"] if v is not None) <= 4.0
