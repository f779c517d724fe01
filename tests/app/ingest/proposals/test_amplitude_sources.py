"""Two sources of an amplitude that differ: both are shown, and the session waits until a person chooses."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.ingest.uploads.redecode import redecode
from app.tables.audit import AuditEvent
from app.tables.recordings import Trace
from ml.formats.recording import DECODE_VERSION
from tests.ml.formats.conftest import START_MS, Rcs, info

ON = {"therapyStatusData": {"activeGroup": 0, "therapyStatus": 1}}


def conflicting_session() -> bytes:
    """Zip an RC+S session of 60 s: the log says 1.5 mA from 20 to 40 s, and settings read at 30.3 s say 2.5 mA."""
    rcs = Rcs()
    x = 0.01 * np.sin(2 * np.pi * 20 * np.arange(500 * 60) / 500)
    stim = rcs.stim((-4, {**ON, **rcs.program(1.0)}), (20, rcs.program(1.5)), (40, rcs.program(2.0)))
    programs = [{"isEnabled": 0 if p == 0 else 131, "amplitudeInMilliamps": 2.5, "pulseWidthInMicroseconds": 60} for p in range(4)]
    read = {
        "RecordInfo": info(START_MS + 30_300),
        "GeneralData": ON,
        "TherapyConfigGroup0": {"rateInHz": 130.2, "programs": programs},
    }
    parts = {"RawDataTD": rcs.time_domain(x), "DeviceSettings": [*rcs.settings(), read], "StimLog": stim}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for stem, content in parts.items():
            archive.writestr(f"Session1/DeviceNPC799999H/{stem}.json", json.dumps(content))
    return out.getvalue()


@pytest.fixture
def proposal(send: Any, proposals: Callable[[], list[dict[str, Any]]]) -> dict[str, Any]:
    """A proposal whose sources differ, though its sender stated visit and controller."""
    answer = send(("s.zip", conflicting_session()), visit=1, controller="random")
    assert answer.status_code == 201, answer.text
    (one,) = proposals()
    return one


def amplitude(db: Session) -> np.ndarray:
    """Read the stored amplitude, mA, NaN where unknown."""
    db.expire_all()
    trace = db.scalars(select(Trace).where(Trace.stream == "amplitude").order_by(Trace.decode_version.desc())).first()
    assert trace is not None
    return np.where(np.isnan(values := np.frombuffer(trace.values_f32, "<f4")), np.nan, values)


def choose(client: TestClient, proposal: dict[str, Any], source: str) -> Any:
    """Choose a source by the interface."""
    path = f"/api/v1/proposals/{proposal['session']['id']}"
    version = client.get(path).json()["version"]
    return client.put(f"{path}/amplitude-source", json={"source": source, "reason": "seen on the programmer", "version": version})


def confirm(client: TestClient, proposal: dict[str, Any]) -> Any:
    """Confirm by the interface, with the newest version."""
    path = f"/api/v1/proposals/{proposal['session']['id']}"
    return client.post(f"{path}/confirm", json={"version": client.get(path).json()["version"]})


def test_a_session_whose_sources_differ_waits_and_shows_both(proposal: dict[str, Any], client: TestClient) -> None:
    (conflict,) = proposal["amplitude_conflicts"]
    assert conflict["sources"] == {"StimLog": "program 0: 1.5 mA", "DeviceSettings": "program 0: 2.5 mA"}
    assert (conflict["from_s"], conflict["to_s"], conflict["chosen"]) == (20.0, 40.0, None)
    refused = confirm(client, proposal)
    assert refused.status_code == 409
    assert "StimLog and DeviceSettings state different amplitudes in 20 to 40 s" in refused.json()["detail"]
    page = client.get(f"/proposals/{proposal['session']['id']}").text
    assert "sources of the amplitude differ" in page
    assert "1.5 mA" in page
    assert "2.5 mA" in page


@pytest.mark.parametrize(
    ("source", "first", "second"), [("StimLog", 1.5, 1.5), ("DeviceSettings", np.nan, 2.5), ("unknown", np.nan, np.nan)]
)
def test_the_chosen_source_counts_and_the_session_can_be_confirmed(
    proposal: dict[str, Any], client: TestClient, db: Session, source: str, first: float, second: float
) -> None:
    assert np.isnan(amplitude(db)[10:20]).all()
    answer = choose(client, proposal, source)
    assert answer.status_code == 200, answer.text
    assert answer.json()[0]["chosen"] == source
    values = amplitude(db)
    np.testing.assert_allclose(values[10:15], first)
    np.testing.assert_allclose(values[16:20], second)
    np.testing.assert_allclose(values[[3, 25]], [1.0, 2.0])
    assert confirm(client, proposal).status_code == 200
    assert choose_again_is_refused(client, proposal)
    reasons = set(db.scalars(select(AuditEvent.reason)))
    assert f"amplitude by {source}: seen on the programmer" in reasons


def choose_again_is_refused(client: TestClient, proposal: dict[str, Any]) -> bool:
    """Check that a confirmed session keeps its choice."""
    path = f"/api/v1/proposals/{proposal['session']['id']}/amplitude-source"
    again = client.put(path, json={"source": "unknown", "reason": "x", "version": 99})
    return again.status_code in (404, 409)


def test_a_newer_decoder_keeps_the_choice(proposal: dict[str, Any], client: TestClient, db: Session) -> None:
    choose(client, proposal, "StimLog")
    for trace in db.scalars(select(Trace)):
        trace.decode_version = DECODE_VERSION - 1
    db.commit()
    assert {c.state for c in redecode(None, None, False, "test")} <= {"changed", "read again", "decoded", "renewed", "redecoded"}
    np.testing.assert_allclose(amplitude(db)[10:20], 1.5)


def test_the_page_chooses_with_a_reason(proposal: dict[str, Any], client: TestClient, db: Session) -> None:
    number = proposal["session"]["id"]
    form = {f"version-{number}": str(proposal["version"]), f"source-{number}": "StimLog", "do": f"amplitude:{number}"}
    refused = client.post("/participants/P1/proposals", data=form)
    assert refused.status_code == 422
    assert "Reason" in refused.text
    done = client.post("/participants/P1/proposals", data=form | {f"source_reason-{number}": "seen"}, follow_redirects=False)
    assert done.status_code == 303
    np.testing.assert_allclose(amplitude(db)[10:20], 1.5)
