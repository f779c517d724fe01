"""The session page of real recordings says what is known of them: gaps, loss, configurations, and which log the amplitude came from."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable
from html import unescape
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.ml.formats.conftest import Percept


@pytest.fixture
def page_of(client: TestClient, recordings: Path) -> Callable[[str, float], str]:
    """Function that uploads a recording as a session of its own participant, at a cDBS amplitude, and returns the session's page."""

    def read(name: str, cdbs_ma: float) -> str:
        assert client.post("/api/v1/participants", json={"code": "R1", "settings": {"cdbs_amplitude_ma": cdbs_ma}}).status_code == 201
        assert client.post("/api/v1/participants/R1/visits", json={"number": 1}).status_code == 201
        fields = {"participant": "R1", "visit": "1", "controller": "other"}
        answer = client.post("/api/v1/uploads", data=fields, files={"file": (name, (recordings / "rcs" / name).read_bytes())})
        assert answer.status_code == 201, answer.text
        session = answer.json()["sessions"][0]["id"]
        return unescape(client.get(f"/sessions/{session}", headers={"Accept": "text/html"}).text)

    return read


def figures(page: str) -> list[Any]:
    scripts = map(json.loads, re.findall(r'<script type="application/json">(.*?)</script>', page, re.S))
    return [f for f in scripts if "layout" in f]


def trace(page: str, name: str) -> Any:
    return next(t for f in figures(page) for t in f["data"] if t.get("name") == name)


def table_after(page: str, title: str) -> list[list[str]]:
    body = page[page.index(title) :]
    body = body[body.index("<tbody>") : body.index("</tbody>")]
    rows = re.findall(r"<tr>(.*?)</tr>", body, re.S)
    return [[re.sub(r"<[^>]+>", "", cell).strip() for cell in re.findall(r"<td[^>]*>(.*?)</td>", row, re.S)] for row in rows]


def test_a_sweep_shows_its_steps_its_spikes_and_the_notes_that_disagree(page_of: Callable[[str, float], str]) -> None:
    page = page_of("stim_sweep.zip", 2.4)
    amplitudes = [float(row[3]) for row in table_after(page, "Stimulation steps")]
    assert amplitudes == [0.0, 0.3, 0.8, 0.6, 0.9, 1.1, 1.3, 1.6, 1.9, 2.2, 2.4]
    assert "n = 4 that disagree; the device's log counts" in page
    assert trace(page, "power spikes left out")["x"]
    assert trace(page, "Band power")["connectgaps"] is False
    assert "group A program 0: 0 to 3.4 mA" in page


def test_under_embedded_adaptive_stimulation_amplitudes_are_those_of_the_adaptive_log(page_of: Callable[[str, float], str]) -> None:
    page = page_of("embedded_adaptive.zip", 6.0)
    assert "Amplitude from</dt><dd>AdaptiveLog" in page
    amplitudes = [float(row[3]) for row in table_after(page, "Stimulation steps")]
    # the log of stimulation says 0 mA all along; the delivered amplitude rises to 6 mA three times
    assert sum(before <= 5.9 < a for before, a in itertools.pairwise([0.0, *amplitudes])) == 3
    assert max(v for v in trace(page, "Amplitude")["y"] if v is not None) == pytest.approx(6.0, abs=0.01)
    assert "0 from 0.1 s, 2 from 10.1 s" in page


def test_a_montage_shows_its_five_configurations_its_loss_and_its_gaps(page_of: Callable[[str, float], str]) -> None:
    page = page_of("montage_packet_loss.zip", 3.0)
    quality = {row[0]: row for row in table_after(page, "Data quality of the whole recording")}
    assert quality["time domain"][1].split()[0] == "2156"
    assert quality["time domain"][2:9] == ["335", "47.3", "23.2", "302", "0", "0", "0"]
    assert "Clock of the computer against the implant" in page
    assert re.search(r"SD 3\d ms, \d+\.\d % of packets beyond 50 ms · drift -\d\d ppm", page)
    configurations = table_after(page, "sensing configurations")
    assert len({row[1] for row in configurations}) == 5
    beta = trace(page, "Beta amplitude")
    assert beta["connectgaps"] is False
    assert sum(v is None for v in beta["y"]) > 50
    assert trace(page, "no valid window")
    spectrum = next(f for f in figures(page) if f["layout"]["yaxis"].get("type") == "log")
    names = [t["name"] for t in spectrum["data"]]
    assert len(set(names)) == len(names), "channels between the same contacts are told apart"
    stn = next(t for t in spectrum["data"] if t["name"] == "contacts +2\N{MINUS SIGN}0 (channel 0)")
    inside = [(y, x) for x, y in zip(stn["x"], stn["y"], strict=True) if 20 <= x <= 35]
    assert 24 <= max(inside)[1] <= 29


def test_annotations_and_ratings_within_a_run_stand_on_the_sessions_page(client: TestClient, participant_code: str) -> None:
    percept = Percept()
    report = percept.one_run(seconds=60.0)
    report["SymptomRatings"] = [
        {"DateTime": "2024-03-14T10:06:12Z", "Symptom": "Tremor", "Rating": 7, "By": "Ada"},
        {"DateTime": "2024-03-14T12:00:00Z", "Symptom": "Rigidity", "Rating": 1},
    ]
    fields = {"participant": participant_code, "visit": "1", "controller": "other"}
    answer = client.post("/api/v1/uploads", data=fields, files={"file": ("r.json", json.dumps(report).encode())})
    session = answer.json()["sessions"][0]["id"]
    page = unescape(client.get(f"/sessions/{session}", headers={"Accept": "text/html"}).text)
    assert table_after(page, "Operator's notes, annotations and ratings") == [["20.0", "tremor: 7 (rating)"]]
