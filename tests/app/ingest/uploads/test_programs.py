"""Two programs on one side, and the other side: learning sees the controlled program alone, energy counts all that stimulated."""

from __future__ import annotations

import copy
import io
import json
import zipfile
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from tests.app.ingest.conftest import device_zip
from tests.app.ingest.proposals.test_proposals import correct, post
from tests.app.words import flat

STEADY_MA = 2.0
"""Of program 0, besides the controlled program 1."""


def with_a_second_program(archive: bytes, moving: bool = False) -> bytes:
    """Add a second program: the controlled one becomes program 1, and program 0 stays at 2 mA (`moving`: at half of the other's)."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as source, zipfile.ZipFile(out, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name.endswith(("DeviceSettings.json", "StimLog.json")):
                records = json.loads(content)
                for record in records:
                    _shift(record.get("TherapyConfigGroup0") or {}, moving)
                content = json.dumps(records).encode()
            target.writestr(name, content)
    return out.getvalue()


def _shift(group: dict[str, Any], moving: bool) -> None:
    if len(group.get("programs", [])) == 4:
        group["programs"][1] = copy.deepcopy(group["programs"][0])
        group["programs"][0] |= {"amplitude": 20, "amplitudeInMilliamps": STEADY_MA}
    if "program0" in group:
        whole, group["program1"] = "pulseWidth" in group["program0"], group.pop("program0")
        if whole or moving:
            tenths = group["program1"]["amplitude"] // 2 if moving else 20
            group["program0"] = {**group["program1"], "amplitude": tenths, "AmplitudeInMilliamps": tenths / 10}


@pytest.fixture
def visit(client: TestClient, participant_code: str) -> int:
    stated = [
        {"hemisphere": "right", "program": 0, "amplitude_ma": STEADY_MA}, {"hemisphere": "right", "program": 1, "amplitude_ma": 3.0},
        {"hemisphere": "left", "program": 0, "amplitude_ma": 2.6},
    ]  # fmt: skip
    body = {"number": 2, "date": "2026-03-02", "cdbs_amplitudes": stated}
    assert client.post(f"/api/v1/participants/{participant_code}/visits", json=body).status_code == 201
    return 2


def amplitudes(client: TestClient, session: int) -> dict[tuple[str, str], np.ndarray]:
    """Return mA of every side and program within a session."""
    traces = client.get(f"/api/v1/sessions/{session}/traces").json()
    return {
        (t["hemisphere"], t["channel"]): np.array([v for v, at in zip(t["values"], t["t_s"], strict=True) if at > 0], dtype=float)
        for t in traces
        if t["stream"] == "amplitude"
    }


def test_the_controlled_program_is_learned_from_and_all_programs_and_sides_are_counted(send: Any, client: TestClient, visit: int) -> None:
    plain = device_zip(("random",), "P1")
    made = send(
        ("right.zip", with_a_second_program(plain)), ("left.zip", device_zip(("random",), "P2")), visit=visit, controller="random",
        hemisphere="right",
    ).json()  # fmt: skip
    session = made["sessions"][0]
    assert session["control_program"] == 1, "program 0 is steady, program 1 moves"
    given = amplitudes(client, session["id"])
    assert set(given) == {("right", "program 0"), ("right", "program 1"), ("left", "program 0")}
    assert np.unique(given["right", "program 0"]).tolist() == [STEADY_MA]
    seen = client.get(f"/api/v1/sessions/{session['id']}/trace").json()
    during = np.array(seen["t_s"]) > 0
    np.testing.assert_allclose(np.array(seen["amplitude_ma"], dtype=float)[during], given["right", "program 1"])
    np.testing.assert_allclose(np.array(seen["amplitude_fraction"], dtype=float)[during], given["right", "program 1"] / 3.0)

    answer = client.get("/api/v1/participants/P1/analyses/energy").json()
    values = {r["measure"]: r["mean"] for r in answer["rows"] if r["controller"] == "random"}
    squares = {key: float(np.mean(v**2)) for key, v in given.items()}
    assert values["mean_a2"] == pytest.approx(squares["right", "program 1"] / 9, rel=1e-5)
    assert values["all_sides_a2"] == pytest.approx(sum(squares.values()) / (3.0**2 + STEADY_MA**2 + 2.6**2), rel=1e-3), (
        "of one width and rate"
    )
    assert values["charge_uc_per_s"] == pytest.approx(sum(float(v.mean()) for v in given.values()) * 1e-3 * 60 * 130, rel=1e-3)
    page = client.get(f"/sessions/{session['id']}", headers={"Accept": "text/html"}).text
    for other in ("right side, program 0", "left side"):
        assert other in page.split("<dt>Stimulated too</dt>")[1][:300]


def test_the_proposal_says_which_program_was_taken_and_a_person_names_another(send: Any, client: TestClient, visit: int) -> None:
    (proposal,) = send(("right.zip", with_a_second_program(device_zip(("random",), "P1"), moving=True)), visit=visit).json()["proposals"]
    why = proposal["evidence"]["program"]
    assert why.startswith("program 1 ")
    assert why.endswith(": several moved, say which one the controller set")
    page = client.get(f"/proposals/{proposal['session']['id']}", headers={"Accept": "text/html"}).text
    assert "Program that the controller set" in flat(page)
    named = correct(client, proposal, control_program=0).json()
    assert (named["session"]["control_program"], named["evidence"]["program"]) == (0, "as stated by admin@clinic.example")
    assert correct(client, named, start_s=4.0).json()["session"]["control_program"] == 0, "what a person stated stays"
    wrong = correct(client, named | {"version": named["version"] + 1}, control_program=3)
    assert (wrong.status_code, "no amplitude of program 3" in wrong.text) == (422, True)
    current = client.get(f"/api/v1/proposals/{named['session']['id']}").json()
    # the settings say another amplitude of program 0 than the log does
    path = f"/api/v1/proposals/{named['session']['id']}"
    choice = {"source": "StimLog", "reason": "as it ran", "version": current["version"]}
    chosen = client.put(f"{path}/amplitude-source", json=choice)
    assert chosen.status_code == (200 if current["amplitude_conflicts"] else 422), chosen.text
    current = client.get(path).json()
    notes = " ".join(post(client, current, "confirm", controller="random").json()["notes"])
    assert "moved as well as that of right side, program 0" in notes


def test_what_is_stated_of_another_program_makes_no_fraction(send: Any, client: TestClient, participant_code: str) -> None:
    body = {"number": 2, "date": "2026-03-02", "cdbs_amplitudes": [{"hemisphere": "right", "program": 0, "amplitude_ma": STEADY_MA}]}
    assert client.post(f"/api/v1/participants/{participant_code}/visits", json=body).status_code == 201
    (proposal,) = send(("right.zip", with_a_second_program(device_zip(("random",), "P1"))), visit=2).json()["proposals"]
    control = next(u for u in proposal["usable_steps"] if u["is_control"])
    assert control["usable"] == 0
    assert "visit 2 states the cDBS amplitude of right, program 0, and none of the right hemisphere, program 1" in control["reason"]
