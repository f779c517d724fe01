"""The samples of a session as Parquet and NWB: the numbers that came, at the times that they have."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from fastapi.testclient import TestClient

from app.overview import samples
from app.platform.database import transaction
from app.tables.sessions import StudySession
from ml.formats import DecodeOptions, decode
from ml.formats.recording import SampleLog
from tests.app.ingest.conftest import device_zip, send, steady  # noqa: F401 (fixture)

RATE = 250


def lfp_table() -> tuple[bytes, np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Write 40 s of samples from 10 s before the session on, of which 5 s are missing; return its bytes, times and samples."""
    t = np.round((np.arange(-10 * RATE, 30 * RATE) + 1) / RATE, 4)
    x = np.round(4 * np.sin(2 * np.pi * 20 * t) + np.random.default_rng(1).standard_normal(t.size), 4)
    there = (t <= 8.0) | (t > 13.0)
    rows = "".join(f"{a},{b},2.0\n" for a, b in zip(t[there], x[there], strict=True))
    return ("t_s,lfp [uV],amplitude_ma\n" + rows).encode(), t[there], x[there]


def taken(client: TestClient, session: int, form: str = "parquet") -> bytes:
    answer = client.get(f"/api/v1/sessions/{session}/samples", params={"format": form})
    assert answer.status_code == 200, answer.text
    return answer.content


@pytest.fixture
def session(send: Any) -> int:  # noqa: F811
    content, _, _ = lfp_table()
    return int(send(("lfp.csv", content), visit=1, controller="cdbs").json()["sessions"][0]["id"])


def test_parquet_holds_every_sample_at_its_time_and_every_trace(client: TestClient, session: int) -> None:
    _, t, x = lfp_table()
    table = pq.read_table(io.BytesIO(taken(client, session)))
    rows = table.to_pandas()
    lfp = rows[rows["stream"] == "lfp"]
    np.testing.assert_allclose(lfp["t_s"], t, atol=1e-6)
    np.testing.assert_allclose(lfp["value"], x, atol=1e-5)
    assert set(lfp["unit"]) == {"uV"}
    for trace in client.get(f"/api/v1/sessions/{session}/traces").json():
        mine = rows[(rows["stream"] == trace["stream"]) & (rows["channel"] == trace["channel"])]
        assert mine["t_s"].tolist() == pytest.approx(trace["t_s"])
        assert [None if v != v else v for v in mine["value"]] == trace["values"]
    about = json.loads(table.schema.metadata[b"betaloop"])
    assert (about["participant"], about["controller"], about["recordings_without_samples"]) == ("P1", "cdbs", [])


def test_nwb_holds_the_same_in_units_of_its_own_and_no_date(client: TestClient, session: int, tmp_path: Path) -> None:
    pynwb = pytest.importorskip("pynwb")
    path = tmp_path / "session.nwb"
    path.write_bytes(taken(client, session, "nwb"))
    assert pynwb.validate(path=str(path)) in ([], ([], 0))
    _, t, x = lfp_table()
    with pynwb.NWBHDF5IO(path, "r") as file:
        content = file.read()
        for place in (content.acquisition, content.processing["lfp"].data_interfaces):
            one, two = place.values()
            assert (one.rate, two.rate) == (RATE, RATE)
            times = [series.starting_time + np.arange(series.data.shape[0]) / series.rate for series in (one, two)]
            np.testing.assert_allclose(np.concatenate(times), t, atol=1e-6)
            values = np.concatenate([series.data[:].ravel() for series in (one, two)])
            np.testing.assert_allclose(values * one.conversion * 1e6, x, atol=1e-5)
            # the rhythm of 20 Hz is where it is: one series with its gap had it at 17.5 Hz by samples over span
            hz = np.fft.rfftfreq(two.data.shape[0], 1 / two.rate)
            assert hz[1:][np.argmax(np.abs(np.fft.rfft(two.data[:].ravel()))[1:])] == pytest.approx(20, abs=0.1)
        invalid = content.invalid_times.to_dataframe()
        np.testing.assert_allclose(invalid[["start_time", "stop_time"]].to_numpy(), [[8.0 + 1 / RATE, 13.0 + 1 / RATE]], atol=1e-5)
        assert content.subject.sex == "U"
        assert content.session_start_time.year in (1969, 1970), "a day since enrolment"
        assert {"beta", "amplitude"} <= {name.split()[2] for name in content.processing["steps"].data_interfaces}


def test_a_device_recording_gives_the_samples_of_its_session_alone(send: Any, client: TestClient, tmp_path: Path) -> None:  # noqa: F811
    """Two stretches of 80 s, 60 s apart; the session is cut to the first minute of the second."""
    content = device_zip(("cdbs", "random"))
    (one,) = send(("two.zip", content), visit=1).json()["proposals"]
    path = tmp_path / "two.zip"
    path.write_bytes(content)
    (whole,) = decode(path, options=DecodeOptions(keep_samples=True)).recordings[0].samples
    with transaction("test") as db:
        row = db.get_one(StudySession, one["session"]["id"])
        row.segments[0].start_s, row.duration_s = 140.0, 60.0
    rows = pq.read_table(io.BytesIO(taken(client, one["session"]["id"]))).to_pandas()
    lfp = rows[rows["stream"] == "lfp"]
    inside = (whole.t_s > 140.0) & (whole.t_s <= 200.000001)
    np.testing.assert_allclose(lfp["t_s"], whole.t_s[inside] - 140.0, atol=1e-6)
    np.testing.assert_array_equal(lfp["value"], whole.values[inside])


def test_a_table_of_steps_has_traces_alone(send: Any, client: TestClient) -> None:  # noqa: F811
    number = send(("steps.csv", steady(1.0)), visit=1, controller="cdbs").json()["sessions"][0]["id"]
    rows = pq.read_table(io.BytesIO(taken(client, number))).to_pandas()
    assert set(rows["stream"]) == {"beta", "amplitude"}


def test_an_installation_without_the_extra_says_what_it_lacks(client: TestClient, session: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, "find_spec", lambda name: None)
    answer = client.get(f"/api/v1/sessions/{session}/samples", params={"format": "nwb"})
    assert answer.status_code == 409
    assert "pynwb is not installed" in answer.json()["detail"]
    assert "betaloop[nwb]" in answer.json()["hint"]


def test_the_page_leads_to_them_and_a_blinded_assessor_gets_none(client: TestClient, session: int, client_as: Any) -> None:
    assert f"/api/v1/sessions/{session}/samples?format=parquet" in client.get(f"/sessions/{session}").text
    assert client_as("blinded_assessor").get(f"/api/v1/sessions/{session}/samples").status_code == 403


def test_a_cut_of_stretches_keeps_where_samples_are_missing() -> None:
    log = SampleLog.of("c", "uV", [(0.0, 2.0, np.arange(4.0)), (5.0, 2.0, np.arange(4.0, 8.0))])
    assert log.t_s.tolist() == [0.0, 0.5, 1.0, 1.5, 5.0, 5.5, 6.0, 6.5]
    cut = log.between(0.5, 5.5)
    assert (cut.values.tolist(), cut.starts.tolist()) == ([2.0, 3.0, 4.0, 5.0], [0, 2])
    assert log.between(2.0, 3.0).starts.size == 0
