"""A device's own history from a Percept report is on a page and in the interface, without what identifies."""

from __future__ import annotations

import json
import zlib
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from fastapi.testclient import TestClient

from app.study.recordings.history_charts import MOST_POINTS
from tests.app.words import flat

BEGIN = datetime(2026, 2, 1, tzinfo=UTC)
NAMES = ("Ada Lovelace", "NPA123456N")


def at(minutes: float) -> str:
    return f"{BEGIN + timedelta(minutes=minutes):%Y-%m-%dT%H:%M:%SZ}"


def group(letter: str, left_ma: float) -> dict[str, object]:
    program = {"AmplitudeInMilliAmps": left_ma, "PulseWidthInMicroSecond": 60, "RateInHertz": 130}
    return {
        "GroupId": f"GroupIdDef.GROUP_{letter}",
        "GroupName": NAMES[0],
        "ActiveGroup": letter == "A",
        "ProgramSettings": {"RateInHertz": 130, "LeftHemisphere": {"Programs": [program]}},
    }


def report() -> bytes:
    averages = [{"DateTime": at(10 * k), "LFP": 100 + k, "AmplitudeInMilliAmps": 2.0} for k in range(300) if not 100 <= k < 110]
    spectrum = {"GroupId": "GroupIdDef.GROUP_A", "Frequency": [0.0, 10.0, 20.0], "FFTBinData": [1.0, 2.0, 3.0]}
    marked = [
        {
            "DateTime": at(60 * k),
            "EventID": k,
            "EventName": name,
            "LFP": True,
            "LfpFrequencySnapshotEvents": {"HemisphereLocationDef.Left": spectrum},
        }
        for k, name in ((1, "Tremor"), (2, NAMES[0]))
    ]
    return json.dumps(
        {
            "SessionDate": at(4000),
            "PatientInformation": {"Initial": {"PatientFirstName": NAMES[0]}},
            "DeviceInformation": {"Initial": {"NeurostimulatorSerialNumber": NAMES[1], "DeviceDateTime": at(4000)}},
            "Groups": {"Final": [group("A", 2.4)]},
            "GroupHistory": [{"SessionDate": at(0), "Groups": [group("A", 1.8), group("B", 0.0)]}],
            "DiagnosticData": {
                "LFPTrendLogs": {"HemisphereLocationDef.Left": {at(4000): averages}},
                "LfpFrequencySnapshotEvents": marked,
            },
            "SymptomRatings": [
                {"DateTime": at(180), "Symptom": "Severe tremor", "Rating": 7, "RatedBy": NAMES[0]},
                {"DateTime": at(190), "Comment": f"{NAMES[0]} felt better"},
            ],
        }
    ).encode()


@pytest.fixture
def uploaded(client: TestClient, participant_code: str) -> str:
    answer = client.post("/api/v1/uploads", data={"participant": participant_code}, files={"file": ("report.json", report())})
    assert answer.status_code == 201, answer.text
    return participant_code


def test_the_history_of_a_device_has_a_route_and_a_page_with_pictures(client: TestClient, uploaded: str) -> None:
    (told,) = client.get(f"/api/v1/participants/{uploaded}/device-history").json()
    (trend,) = told["trends"]
    assert (trend["side"], len(trend["unix_s"]), trend["power"][:2], set(trend["amplitude_ma"])) == ("left", 290, [100.0, 101.0], {2.0})
    assert [(s["label"], s["side"], s["magnitude"]) for s in told["snapshots"]] == [
        ("tremor", "left", [1.0, 2.0, 3.0]), ("event 2", "left", [1.0, 2.0, 3.0])
    ]  # fmt: skip
    assert [(e["kind"], e["label"], e["value"], e["at"][:16]) for e in told["events"]] == [
        ("patient", "tremor", None, at(60)[:16]), ("patient", "event 2", None, at(120)[:16]),
        ("rating", "severe tremor", 7.0, at(180)[:16]), ("annotation", "symptom ratings", None, at(190)[:16]),
    ]  # fmt: skip
    assert [(g["name"], g["active"], g["programs"][0]["amplitude_ma"]) for g in told["groups"]] == [
        ("A", True, 1.8), ("B", False, 0.0), ("A", True, 2.4)
    ]  # fmt: skip
    page = flat(client.get(f"/participants/{uploaded}/device-history", headers={"Accept": "text/html"}).text)
    for chart in ("trend-power", "trend-amplitude", "groups", "snapshot-left"):
        assert f'id="{chart}-{told["recording_id"]}"' in page
    assert "left: 290 averages" in page
    assert "2 marked by the patient, 2 annotations and ratings, 0 logged by the device" in page
    assert '<td>severe tremor</td><td class="num">7</td>' in page
    assert not any(name in text for name in NAMES for text in (page, json.dumps(told)))


def test_missing_averages_are_a_gap_and_the_table_has_a_row_per_day(client: TestClient, uploaded: str) -> None:
    page = flat(client.get(f"/participants/{uploaded}/device-history", headers={"Accept": "text/html"}).text)
    table = page.split('id="trend-power-')[1].split("</figure>")[0]
    assert [day in table for day in ("2026-02-01", "2026-02-02", "2026-02-03", "2026-02-04")] == [True, True, True, False]
    assert "null" in table, "ten missing averages break the line"


def test_sixty_days_of_both_sides_are_drawn_by_their_extremes_and_the_page_stays_small(client: TestClient, participant_code: str) -> None:
    """Sixty days is the most that a device keeps. A spike of ten minutes stays, and so does the gap."""
    rng = np.random.default_rng(3)
    content = json.loads(report())
    logs = {}
    for side in ("Left", "Right"):
        power = rng.integers(50, 400, 8640).tolist()
        power[5001] = 900
        averages = [{"DateTime": at(10 * k), "LFP": p, "AmplitudeInMilliAmps": 2.0 + 0.1 * (k > 6000)} for k, p in enumerate(power)]
        logs[f"HemisphereLocationDef.{side}"] = {at(86400): averages[:7000] + averages[7010:]}
    content["DiagnosticData"]["LFPTrendLogs"] = logs
    sent = client.post("/api/v1/uploads", data={"participant": participant_code}, files={"file": ("r.json", json.dumps(content).encode())})
    assert sent.status_code == 201, sent.text
    page = client.get(
        f"/participants/{participant_code}/device-history", headers={"Accept": "text/html", "Accept-Encoding": "identity"}
    ).text
    assert len(zlib.compress(page.encode())) < 40_000
    chart = page.split('id="trend-power-')[1].split("</figure>")[0]
    assert "lowest and highest of every 2 h" in chart
    lines = json.loads(chart.split('<script type="application/json">')[1].split("</script>")[0])["data"][:2]
    for line in lines:
        assert len(line["y"]) <= 1.05 * MOST_POINTS
        assert max(v for v in line["y"] if v is not None) == 900
        assert line["x"][line["y"].index(900)][:16] == at(50010)[:16]
        assert line["y"].count(None) == 1
    levels = page.split('id="trend-amplitude-')[1].split('<script type="application/json">')[1].split("</script>")[0]
    assert set(json.loads(levels)["data"][0]["y"]) == {2.0, 2.1, None}, "no amplitude that was never set"


def test_a_participant_without_a_report_is_told_what_is_needed(client: TestClient, participant_code: str) -> None:
    assert client.get(f"/api/v1/participants/{participant_code}/device-history").json() == []
    page = client.get(f"/participants/{participant_code}/device-history", headers={"Accept": "text/html"}).text
    assert "Needed: a Percept session report with a history" in page


def test_a_blinded_assessor_sees_no_history_of_amplitudes(client_as, uploaded: str) -> None:  # type: ignore[no-untyped-def]
    assert client_as("blinded_assessor").get(f"/api/v1/participants/{uploaded}/device-history").status_code in (403, 404)
