"""Files that were read wrongly once, through the upload route: each has its right value, or a refusal that says what to do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from tests.app.ingest.conftest import steady

pytestmark = pytest.mark.usefixtures("participant_code")


def upload(client: TestClient, recordings: Path, name: str) -> Any:
    """Post one of the reported files for P1, with its session left open."""
    content = (recordings / "reported" / name).read_bytes()
    return client.post("/api/v1/uploads", data={"participant": "P1"}, files={"file": (name, content)})


def amplitudes(client: TestClient, answer: Any) -> np.ndarray:
    """Read the amplitude of the session's steps in mA, NaN where unknown."""
    assert answer.status_code == 201, answer.json()
    (session,) = answer.json()["sessions"]
    trace = client.get(f"/api/v1/sessions/{session['id']}/trace").json()
    return np.array([np.nan if a is None else a for t, a in zip(trace["t_s"], trace["amplitude_ma"], strict=True) if t > 0])


def test_a_cut_stimulation_log_is_believed_to_its_end_and_no_further(client: TestClient, recordings: Path) -> None:
    answer = upload(client, recordings, "06-rcs-stimlog-cut.zip")
    values = amplitudes(client, answer)
    np.testing.assert_allclose(values[:29], 1.0)
    np.testing.assert_allclose(values[31:59], 1.5)
    assert np.isnan(values[62:]).all()
    assert any("the amplitude is unknown" in text for report in answer.json()["report"] for text in report["flagged"])


def test_cycling_therapy_is_told_and_its_amplitude_is_unknown(client: TestClient, recordings: Path) -> None:
    answer = upload(client, recordings, "11-rcs-cycling.zip")
    assert np.isnan(amplitudes(client, answer)).all()
    assert "cycles (60 s on, 60 s off)" in repr(answer.json()["report"])


def test_times_in_single_precision_give_the_true_rate(client: TestClient, recordings: Path) -> None:
    answer = upload(client, recordings, "08-lfp-single-precision-times.csv")
    assert answer.status_code == 201
    report = repr(answer.json()["report"])
    assert "250 Hz: 6000 samples, 24.0 s of signal" in report
    assert "missing" not in report


@pytest.mark.parametrize(
    ("name", "mend"),
    [("09-steps-thousands-point.csv", "may mean 1266 or 1.266"), ("10-steps-seconds-of-the-day.csv", "seconds of the day")],
)
def test_what_may_mean_two_things_is_refused_with_its_mend(
    client: TestClient, recordings: Path, name: str, mend: str
) -> None:  # fmt: skip
    answer = upload(client, recordings, name)
    assert answer.status_code == 422
    assert mend in repr(answer.json())


def test_closed_fists_are_no_open_ones(client: TestClient, recordings: Path) -> None:
    session = client.post(
        "/api/v1/uploads", data={"participant": "P1", "visit": "1", "controller": "cdbs"}, files={"file": ("t.csv", steady(1.0))}
    )
    number = session.json()["sessions"][0]["id"]
    content = (recordings / "reported" / "13-grasp-open-and-close.csv").read_bytes()
    answer = client.post("/api/v1/uploads", data={"participant": "P1", "session": str(number)}, files={"file": ("grasp.csv", content)})
    assert answer.status_code == 201, answer.text
    assert "20 open fists" in repr(answer.json()["report"])
    assert client.get(f"/api/v1/sessions/{number}/qoc").json()["grasp_hz"] == pytest.approx(1.0, abs=0.05)
