"""Tremor and grasp files among the files of a visit: they find their session, or wait for one."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.app.ingest.conftest import DAY, device_zip, steady

GRASPS = b"t_s\n" + b"".join(b"%.2f\n" % (0.4 * k) for k in range(11))


def tremor(minutes: int = 4, share: float = 0.25) -> bytes:
    """Write a wide export: `minutes` minutes from ten o'clock on, with `share` mild tremor in each."""
    begin = int(DAY.timestamp())
    rows = [f"{begin + 60 * k},60,0,{1 - share},0,{share},0,0,{share}" for k in range(minutes)]
    return "\n".join(["time,duration_s,unknown,none,slight,mild,moderate,strong,any_tremor", *rows]).encode() + b"\n"


def qoc(client: TestClient, session_id: int) -> dict[str, Any]:
    return dict(client.get(f"/api/v1/sessions/{session_id}/qoc").json() or {})


def test_grasps_go_to_the_only_session_of_their_upload(send: Any, client: TestClient) -> None:
    body = send(("t.csv", steady(1)), ("g.csv", GRASPS), visit=1, controller="cdbs").json()
    (session,) = body["sessions"]
    assert [f["session_ids"] for f in body["files"]] == [[session["id"]]] * 2
    assert qoc(client, session["id"])["grasp_hz"] == pytest.approx(2.5)


def test_grasps_of_a_proposal_count_when_it_is_confirmed(send: Any, client: TestClient) -> None:
    body = send(("t.csv", steady(1)), ("g.csv", GRASPS), visit=1).json()
    (proposal,) = body["proposals"]
    number = proposal["session"]["id"]
    assert qoc(client, number) == {}
    confirmed = client.post(f"/api/v1/proposals/{number}/confirm", json={"version": proposal["version"]})
    assert confirmed.status_code == 200
    assert qoc(client, number)["grasp_hz"] == pytest.approx(2.5)
    assert any("grasp" in n for n in confirmed.json()["notes"])


def test_grasps_without_a_session_wait_and_can_be_attached(send: Any, client: TestClient) -> None:
    session = send(("t.csv", steady(1)), visit=1, controller="cdbs").json()["sessions"][0]["id"]
    answer = send(("g.csv", GRASPS))
    assert answer.status_code == 201
    assert any("names no clock" in s for s in answer.json()["report"][0]["understood"])
    file = answer.json()["files"][0]
    attached = client.post(f"/api/v1/uploaded-files/{file['id']}/session", json={"session_id": session})
    assert attached.status_code == 200, attached.text
    assert attached.json()["session"]["qoc"]["grasp_hz"] == pytest.approx(2.5)
    other = send(("u.csv", steady(0)), visit=1, controller="no_dbs").json()["sessions"][0]["id"]
    assert client.post(f"/api/v1/uploaded-files/{file['id']}/session", json={"session_id": other}).status_code == 409


def test_grasps_sent_again_with_a_session_are_attached_to_it(send: Any, client: TestClient) -> None:
    session = send(("t.csv", steady(1)), visit=1, controller="cdbs").json()["sessions"][0]["id"]
    send(("g.csv", GRASPS))
    again = send(("g.csv", GRASPS), session=session).json()
    assert again["duplicate"] is True
    assert again["files"][0]["session_ids"] == [session]
    assert qoc(client, session)["grasp_hz"] == pytest.approx(2.5)


def test_a_session_that_is_not_the_participants_is_refused(send: Any) -> None:
    answer = send(("g.csv", GRASPS), session=4711)
    assert answer.status_code == 422
    assert "no session 4711" in answer.json()["detail"]


@pytest.mark.parametrize("tremor_first", [True, False])
def test_tremor_minutes_reach_their_session_in_whatever_order_they_come(send: Any, client: TestClient, tremor_first: bool) -> None:
    def recording() -> None:
        send(("s.zip", device_zip(steps=60)), visit=1, controller="random")

    def minutes() -> None:
        assert send(("tremor.csv", tremor())).json()["files"][0]["kind"] == "tremor"

    for step in (minutes, recording) if tremor_first else (recording, minutes):
        step()
    (session,) = client.get("/api/v1/visits/1/sessions").json()["items"]
    assert session["qoc"]["tremor_percent"] == pytest.approx(25)


def test_tremor_counts_for_a_proposal_once_it_is_confirmed_with_its_own_times(send: Any, client: TestClient) -> None:
    (proposal,) = send(("s.zip", device_zip(steps=60)), ("tremor.csv", tremor())).json()["proposals"]
    number = proposal["session"]["id"]
    assert qoc(client, number) == {}
    body = {"version": proposal["version"], "controller": "random"}
    assert client.post(f"/api/v1/proposals/{number}/confirm", json=body).status_code == 200
    assert qoc(client, number)["tremor_percent"] == pytest.approx(25)


def test_a_dropped_proposal_gives_its_grasp_file_back(send: Any, client: TestClient) -> None:
    body = send(("t.csv", steady(1)), ("g.csv", GRASPS), visit=1).json()
    (proposal,) = body["proposals"]
    path = f"/api/v1/proposals/{proposal['session']['id']}/discard"
    assert client.post(path, json={"version": proposal["version"], "reason": "no session"}).status_code == 204
    session = send(("u.csv", steady(0)), visit=1, controller="no_dbs").json()["sessions"][0]["id"]
    attached = client.post(f"/api/v1/uploaded-files/{body['files'][1]['id']}/session", json={"session_id": session})
    assert attached.status_code == 200, attached.text
