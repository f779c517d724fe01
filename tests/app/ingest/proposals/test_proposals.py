"""Sessions proposed from files: what is guessed, what a person corrects, and that nothing counts before."""

from __future__ import annotations

import io
import threading
import zipfile
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.overview.package import export_participant
from app.platform.errors import Invalid
from app.study import repository as study
from app.tables.audit import AuditEvent
from tests.app.ingest.conftest import device_zip, loose, steady, table

Json = dict[str, Any]


def post(client: TestClient, proposal: Json, what: str, **fields: Any) -> Any:
    body = {"version": proposal["version"]} | fields
    return client.post(f"/api/v1/proposals/{proposal['session']['id']}/{what}", json=body)


def correct(client: TestClient, proposal: Json, **fields: Any) -> Any:
    return client.patch(f"/api/v1/proposals/{proposal['session']['id']}", json={"version": proposal["version"]} | fields)


def test_without_a_controller_an_upload_proposes_and_says_why(send: Any, proposals: Any) -> None:
    answer = send(("s.zip", device_zip(("cdbs",))))
    assert answer.status_code == 201, answer.text
    (proposal,) = answer.json()["proposals"]
    session = proposal["session"]
    assert (session["status"], session["visit"], proposal["visit_open"]) == ("proposed", 1, False)
    assert proposal["evidence"]["visit"] == "recorded on 2026-03-02, the day of visit 1"
    assert session["hemisphere"] == "right"
    assert session["started_at"].startswith("2026-03-02T10:00")
    assert proposals() == [proposal]
    assert any("counts nowhere until it is confirmed" in s for s in answer.json()["report"][0]["understood"])


@pytest.mark.parametrize(("level", "guess"), [(0, "no_dbs"), (1, "cdbs"), (0.96, "cdbs"), (0.5, None)])
def test_the_controller_is_proposed_by_plain_rules(send: Any, level: float, guess: str | None) -> None:
    (proposal,) = send(("t.csv", steady(level)), visit=1).json()["proposals"]
    assert proposal["session"]["controller"] == guess


def test_a_table_tells_no_date_so_that_its_visit_is_open_unless_stated(send: Any) -> None:
    (proposal,) = send(("t.csv", steady(0))).json()["proposals"]
    assert proposal["visit_open"]
    assert "states no date" in proposal["evidence"]["visit"]
    (stated,) = send(("u.csv", steady(0, beta=2.0)), visit=1).json()["proposals"]
    assert not stated["visit_open"]


def test_confirm_false_keeps_a_stated_controller_as_a_proposal(send: Any, proposals: Any) -> None:
    answer = send(("t.csv", steady(1)), visit=1, controller="random", confirm="false").json()
    assert [s["status"] for s in answer["sessions"]] == ["proposed"]
    assert proposals()[0]["session"]["controller"] == "random"
    assert proposals()[0]["evidence"]["controller"] == "as stated with the upload"


def test_a_controller_without_a_visit_is_refused_in_words(send: Any) -> None:
    answer = send(("t.csv", steady(1)), controller="random")
    assert answer.status_code == 422
    assert "no visit" in answer.json()["detail"]


def test_a_proposal_counts_nowhere_until_it_is_confirmed(send: Any, client: TestClient, participant_code: str, db: Session) -> None:
    counted = send(("c.csv", steady(1)), visit=1, controller="cdbs").json()["sessions"][0]
    (proposal,) = send(("p.csv", steady(0.5, beta=0.5)), visit=1).json()["proposals"]
    number = proposal["session"]["id"]
    visit = counted["visit_id"]

    def everywhere() -> dict[str, set[int]]:
        person = study.participant_by_code(db, participant_code, SYSTEM)
        with zipfile.ZipFile(io.BytesIO(export_participant(db, person, SYSTEM))) as z:
            rows = z.read(f"{participant_code}/sessions.csv").decode().splitlines()[1:]
        snapshot = client.post(f"/api/v1/participants/{participant_code}/snapshots").json()
        return {
            "visit": {s["id"] for s in client.get(f"/api/v1/visits/{visit}/sessions").json()["items"]},
            "export": {int(r.split(",")[0]) for r in rows},
            "buffer": {s["session_id"] for s in snapshot["members"]},
            "analysis": {client.get(f"/api/v1/participants/{participant_code}/analyses").json()["sessions"]},
        }

    before = everywhere()
    assert number not in before["visit"] | before["export"] | before["buffer"]
    assert before["analysis"] == {1}
    assert client.put(f"/api/v1/sessions/{number}/qoc", json={"rating": 5}).status_code == 409
    assert client.patch(f"/api/v1/sessions/{number}", json={"controller": "rl"}).status_code == 409
    confirmed = post(client, proposal, "confirm", controller="random")
    assert confirmed.status_code == 200, confirmed.text
    assert confirmed.json()["session"]["status"] == "confirmed"
    db.expire_all()
    after = everywhere()
    assert number in after["visit"] & after["export"] & after["buffer"]
    assert after["analysis"] == {2}


def test_a_buffer_of_proposals_alone_is_refused(send: Any, client: TestClient, participant_code: str) -> None:
    send(("p.csv", steady(1)), visit=1)
    answer = client.post(f"/api/v1/participants/{participant_code}/snapshots")
    assert answer.status_code == Invalid.status
    assert "no confirmed session" in answer.text


def test_what_is_open_must_be_stated_before_it_counts(send: Any, client: TestClient) -> None:
    (proposal,) = send(("p.csv", steady(0.5))).json()["proposals"]
    refused = post(client, proposal, "confirm")
    assert refused.status_code == 422
    assert "visit and controller is open" in refused.json()["detail"]
    assert client.get(f"/api/v1/proposals/{proposal['session']['id']}").json() == proposal
    assert post(client, proposal, "confirm", visit=1, controller="other").status_code == 200
    assert client.get(f"/api/v1/proposals/{proposal['session']['id']}").status_code == 404


def test_two_tabs_do_not_overwrite_each_other(send: Any, client: TestClient, proposals: Any) -> None:
    (seen,) = send(("p.csv", steady(0.5)), visit=1).json()["proposals"]
    assert correct(client, seen, controller="random").json()["version"] == 2
    late = correct(client, seen, controller="cdbs")
    assert late.status_code == 409
    assert "admin@clinic.example" in late.json()["detail"]
    assert proposals()[0]["session"]["controller"] == "random"
    assert post(client, seen, "confirm").status_code == 409
    assert post(client, seen, "discard", reason="no").status_code == 409
    assert post(client, seen, "split", parts=[{"start_s": 0, "stop_s": 10}]).status_code == 409


def test_two_confirmations_at_once_make_one_session(send: Any, client: TestClient, service_app: Any) -> None:
    (seen,) = send(("p.csv", steady(1)), visit=1).json()["proposals"]
    answers: list[int] = []

    def go() -> None:
        other = TestClient(service_app, headers={"Authorization": client.headers["authorization"]})
        answers.append(post(other, seen, "confirm").status_code)

    threads = [threading.Thread(target=go) for _ in range(3)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert sorted(answers) == [200, 409, 409]


def test_the_two_implants_of_one_time_are_one_session_whichever_files_they_came_in(send: Any, client: TestClient) -> None:
    right, left = device_zip(("random",), "P1"), device_zip(("random",), "P2", minute=0.2)
    answer = send(("right.zip", right), ("left.zip", left)).json()
    (proposal,) = answer["proposals"]
    assert [f["session_ids"] for f in answer["files"]] == [[proposal["session"]["id"]]] * 2
    assert {p["hemisphere"] for p in proposal["parts"]} == {"left", "right"}
    assert sum(p["is_control"] for p in proposal["parts"]) == 1
    other = {"left": "right", "right": "left"}[proposal["session"]["hemisphere"]]
    turned = correct(client, proposal, hemisphere=other).json()
    assert [p["hemisphere"] for p in turned["parts"] if p["is_control"]] == [other]


def test_the_other_implant_may_come_in_a_later_upload(send: Any, proposals: Any) -> None:
    send(("right.zip", device_zip(("random",), "P1")))
    answer = send(("left.zip", device_zip(("random",), "P2", minute=0.2))).json()
    (proposal,) = proposals()
    assert {p["hemisphere"] for p in proposal["parts"]} == {"left", "right"}
    assert any("Recorded at the same time as proposed session" in s for s in answer["report"][0]["understood"])


def test_recordings_of_different_times_are_different_sessions(send: Any) -> None:
    answer = send(("a.zip", device_zip(minute=0)), ("b.zip", device_zip(minute=20, seed=8))).json()
    starts = [p["session"]["started_at"][:16] for p in answer["proposals"]]
    assert starts == ["2026-03-02T10:00", "2026-03-02T10:20"]


def test_one_long_recording_is_cut_into_its_sessions(send: Any, client: TestClient, proposals: Any) -> None:
    archive = device_zip(("cdbs", "no_dbs"), steps=40, gap_s=30)
    (whole,) = send(("long.zip", archive)).json()["proposals"]
    length = whole["parts"][0]["recording_s"]
    made = post(client, whole, "split", parts=[{"start_s": 30, "stop_s": 90}, {"start_s": 160, "stop_s": 220, "controller": "no_dbs"}])
    assert made.status_code == 201, made.text
    first, second = made.json()
    assert [s["session"]["id"] for s in proposals()] == [first["session"]["id"], second["session"]["id"]]
    assert client.get(f"/api/v1/proposals/{whole['session']['id']}").status_code == 404
    assert (first["parts"][0]["start_s"], first["parts"][0]["stop_s"], first["session"]["duration_s"]) == (30, 90, 60)
    assert first["parts"][0]["recording_s"] == length
    assert second["session"]["started_at"] > first["session"]["started_at"]
    assert second["session"]["controller"] == "no_dbs"
    lead = client.get(f"/api/v1/sessions/{second['session']['id']}/trace").json()
    assert sum(b is not None for b, t in zip(lead["beta"], lead["t_s"], strict=True) if t <= 0) == 10
    # the same stretch cannot count twice
    assert post(client, first, "confirm", controller="cdbs").status_code == 200
    overlapping = post(client, second, "confirm", start_s=60, stop_s=120)
    assert overlapping.status_code == 409
    assert "already belong to session" in overlapping.json()["detail"]
    assert post(client, second, "confirm").status_code == 200


def test_a_part_of_a_recording_can_be_chosen_by_the_clock_or_by_its_seconds(send: Any, client: TestClient) -> None:
    (whole,) = send(("s.zip", device_zip())).json()["proposals"]
    begin = whole["session"]["started_at"]
    later = correct(client, whole, started_at=begin.replace("10:00:", "10:01:"), stop_s=80).json()
    assert (later["parts"][0]["start_s"], later["parts"][0]["stop_s"]) == (60, 80)
    assert later["session"]["started_at"][:16] == "2026-03-02T10:01"
    assert later["session"]["duration_s"] == 20


@pytest.mark.parametrize(
    "part",
    [{"start_s": 1000, "stop_s": 1010}, {"start_s": 10, "stop_s": 10}, {"start_s": 20, "stop_s": 10}, {"start_s": 0, "stop_s": 5000}],
)
def test_a_part_outside_its_recording_is_refused(send: Any, client: TestClient, proposals: Any, part: Json) -> None:
    (whole,) = send(("t.csv", steady(1)), visit=1).json()["proposals"]
    assert correct(client, whole, **part).status_code == 422
    assert post(client, whole, "split", parts=[part]).status_code == 422
    assert proposals() == [whole]


def test_parts_that_share_time_are_refused(send: Any, client: TestClient) -> None:
    (whole,) = send(("t.csv", steady(1)), visit=1).json()["proposals"]
    answer = post(client, whole, "split", parts=[{"start_s": 0, "stop_s": 20}, {"start_s": 10, "stop_s": 30}])
    assert answer.status_code == 422
    assert "share the time from 10 to 20 s" in answer.json()["detail"]


def test_what_is_no_session_is_dropped_with_a_reason_and_the_same_file_proposes_it_anew(
    send: Any, client: TestClient, proposals: Any, db: Session
) -> None:
    content = steady(1)
    (proposal,) = send(("t.csv", content), visit=1).json()["proposals"]
    assert post(client, proposal, "discard", reason="").status_code == 422
    assert post(client, proposal, "discard", reason="a test of the tablet").status_code == 204
    assert proposals() == []
    event = db.scalars(select(AuditEvent).where(AuditEvent.entity == "session", AuditEvent.action == "delete")).one()
    assert event.reason == "a test of the tablet"
    again = send(("t.csv", content), visit=1).json()
    assert again["duplicate"] is True
    assert len(again["proposals"]) == 1
    assert [p["session"]["id"] for p in proposals()] == [again["proposals"][0]["session"]["id"]]


def test_a_proposal_that_a_data_query_is_about_is_neither_dropped_nor_cut(send: Any, client: TestClient, proposals: Any) -> None:
    (proposal,) = send(("s.csv", steady(1))).json()["proposals"]
    query = {"session_id": proposal["session"]["id"], "field": "other", "text": "Is this a session?"}
    numbers = [client.post("/api/v1/participants/P1/data-queries", json=query).json()["id"] for _ in range(2)]
    for what, done, fields in (("discard", "dropped", {"reason": "no"}), ("split", "cut", {"parts": [{"start_s": 0, "stop_s": 10}]})):
        answer = post(client, proposal, what, **fields)
        said = f"cannot be {done}: data queries {numbers[0]}, {numbers[1]} are about it"
        assert (answer.status_code, said in answer.json()["detail"]) == (409, True), answer.text
    assert [p["session"]["id"] for p in proposals()] == [proposal["session"]["id"]]


def test_the_same_bytes_again_give_the_same_proposal(send: Any, proposals: Any) -> None:
    first = send(("t.csv", steady(1)), visit=1).json()
    again = send(("copy.csv", steady(1)), visit=1).json()
    assert again["duplicate"] is True
    assert again["proposals"] == first["proposals"] == proposals()


def test_fractions_become_milliamperes_of_the_visit_they_are_confirmed_for(send: Any, client: TestClient, participant_code: str) -> None:
    body = {"number": 2, "date": "2026-03-30", "cdbs_amplitudes": [{"hemisphere": "left", "amplitude_ma": 2.0}]}
    assert client.post(f"/api/v1/participants/{participant_code}/visits", json=body).status_code == 201
    (proposal,) = send(("t.csv", steady(0.5)), visit=1).json()["proposals"]
    number = proposal["session"]["id"]
    assert post(client, proposal, "confirm", visit=2, hemisphere="left", controller="other").status_code == 200
    client.put(f"/api/v1/participants/{participant_code}/settings", json={"settings": {"cdbs_amplitude_ma": 9.0}})
    assert client.get(f"/api/v1/sessions/{number}/trace").json()["amplitude_ma"][-1] == pytest.approx(1.0)


def test_a_confirmed_session_that_contradicts_its_amplitude_or_day_is_told(send: Any, client: TestClient) -> None:
    (proposal,) = send(("s.zip", device_zip(("cdbs",)))).json()["proposals"]
    client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2026-03-30"})
    notes = post(client, proposal, "confirm", visit=2, controller="no_dbs").json()["notes"]
    assert any("Said to be without DBS" in n for n in notes)
    assert any("Recorded on 2026-03-02, but visit 2 is dated 2026-03-30" in n for n in notes)


def test_a_policy_needs_a_controller_that_can_have_one_and_must_exist(send: Any, client: TestClient) -> None:
    (proposal,) = send(("t.csv", steady(1)), visit=1).json()["proposals"]
    assert "no policy 'ghost'" in correct(client, proposal, controller="rl", policy="ghost").json()["detail"]


def test_a_viewer_may_look_and_not_decide(send: Any, client_as: Any) -> None:
    (proposal,) = send(("t.csv", steady(1)), visit=1).json()["proposals"]
    viewer = client_as("viewer")
    assert viewer.get("/api/v1/participants/P1/proposals").json() == [proposal]
    assert post(viewer, proposal, "confirm").status_code == 403
    assert correct(viewer, proposal, controller="rl").status_code == 403


def test_a_table_of_loose_steps_is_no_rcs_file(send: Any) -> None:
    assert len(loose(device_zip())) == 11
    answer = send(("EventLog.csv", table([(0, 1, 1), (2, 1, 1)])), visit=1)
    assert answer.json()["files"][0]["kind"] == "csv"
