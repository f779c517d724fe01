"""Usable steps are reported with the upload, by channel, with the reason where there are none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.tables.recordings import Recording
from app.tables.sessions import SessionSegment


def told(answer: dict[str, Any]) -> str:
    return " ".join(line for report in answer.get("report", []) for line in (*report["understood"], *report["flagged"]))


def montage(recordings: Path) -> tuple[str, bytes]:
    return "m.zip", (recordings / "rcs" / "montage_packet_loss.zip").read_bytes()


def test_a_recording_with_packet_loss_has_20_usable_steps_over_its_time_domain_channels(
    send: Any, client: TestClient, recordings: Path
) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 3.0, "most_imputed": 1}})
    answer = send(montage(recordings)).json()
    (proposal,) = answer["proposals"]
    first, *rest = proposal["usable_steps"]
    # of the subthalamic lead, though one of motor cortex has more; of that lead the one with the most, though another has more valid steps
    assert (first["channel"], first["source"], first["is_control"]) == ("key 0 +1-0", "time_domain", True)
    found = {u["channel"]: u["usable"] for u in proposal["usable_steps"] if u["source"] == "time_domain"}
    lead = {channel: usable for channel, usable in found.items() if channel.startswith(("key 0", "key 1"))}
    assert first["usable"] == max(lead.values()) == 10
    assert (lead["key 1 +3-1"], found["key 2 +9-8"], found["key 2 +11-9"]) == (4, 18, 3)
    assert first["reason"] is None
    # five configurations of 20 steps, of which the first ten are a state's window: no channel that was sensed in one alone can have more
    assert 20 <= proposal["usable_on_any"] == 25 <= sum(found.values())
    assert "; 25 on one time-domain channel or another, which were sensed one after another; " in told(answer)
    assert len(rest) == 12
    assert all((u["reason"] is None) == (u["usable"] > 0) for u in rest)
    assert "Usable steps: 10 of 103 on beta key 0 +1-0" in told(answer)
    why = proposal["evidence"]["control"]
    assert why.startswith("beta key 0 +1-0 of the left STN, with 10 usable steps; not ")
    best = ("key 2 +9-8 (left M1, 18 usable steps)", "key 1 +3-2 (left STN, 10 usable steps)", "key 3 +11-10 (left M1, 10 usable steps)")
    assert why.endswith(f"; not {', '.join(best)} or 9 others")
    page = client.get(f"/proposals/{proposal['session']['id']}", headers={"Accept": "text/html"}).text
    assert "Steps that can be learned from, of 103" in page
    assert f"<td>{first['usable']}</td>" in page
    assert "key 1 +3-2 (left STN, 10 usable steps)" in page


def test_the_channel_is_chosen_anew_for_another_part_until_a_person_states_one(send: Any, client: TestClient, recordings: Path) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 3.0, "most_imputed": 1}})
    (proposal,) = send(montage(recordings)).json()["proposals"]
    number = proposal["session"]["id"]
    cut = client.patch(f"/api/v1/proposals/{number}", json={"version": 1, "start_s": 0, "stop_s": 40}).json()
    first = cut["usable_steps"][0]
    assert (first["channel"], first["usable"]) == ("key 0 +2-0", 4), "what was sensed in the first 40 s"
    assert cut["evidence"]["control"].startswith("beta key 0 +2-0 of the left STN, with 4 usable steps")
    stated = {"version": 2, "control_stream": "beta", "control_channel": "key 1 +3-1"}
    assert client.patch(f"/api/v1/proposals/{number}", json=stated).status_code == 200
    later = client.patch(f"/api/v1/proposals/{number}", json={"version": 3, "start_s": 40, "stop_s": 84}).json()
    assert later["session"]["control_channel"] == "key 1 +3-1", "a person's word stays"
    parts = [{"start_s": 0, "stop_s": 40}, {"start_s": 40, "stop_s": 84}]
    made = client.post(f"/api/v1/proposals/{number}/split", json={"version": 4, "parts": parts}).json()
    assert {p["session"]["control_channel"] for p in made} == {"key 1 +3-1"}


def test_every_part_of_a_cut_recording_gets_its_own_channel(send: Any, client: TestClient, recordings: Path) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 3.0, "most_imputed": 1}})
    (proposal,) = send(montage(recordings)).json()["proposals"]
    number = proposal["session"]["id"]
    parts = [{"start_s": 0, "stop_s": 40}, {"start_s": 42, "stop_s": 84}]
    made = client.post(f"/api/v1/proposals/{number}/split", json={"version": 1, "parts": parts}).json()
    firsts = [p["usable_steps"][0] for p in made]
    assert [(u["channel"], u["is_control"]) for u in firsts] == [("key 0 +2-0", True), ("key 0 +1-0", True)]
    assert firsts[1]["usable"] > 0


def test_without_imputed_values_there_are_fewer_and_the_reason_names_the_gaps(send: Any, client: TestClient, recordings: Path) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 3.0, "most_imputed": 0}})
    (proposal,) = send(montage(recordings)).json()["proposals"]
    found = {u["channel"]: u for u in proposal["usable_steps"]}
    assert found["key 2 +9-8"]["usable"] < 20
    assert found["key 0 +3-0"]["reason"] == ("its 17 valid steps are nowhere 11 in a row without a gap, as a state and its next beta need")


def every(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


NO_SESSION = (
    "no session", "nothing in it can be a session", "a recording without data", "minutes of tremor", "A grasp file names no clock",
)  # fmt: skip
"""What the report of a file says of recordings that no session is made of."""


def test_every_recording_shows_its_usable_steps_or_says_why_it_has_none(
    send: Any, client: TestClient, recordings: Path, db: Session
) -> None:
    known: set[int] = set()
    for path in every(recordings):
        before = set(db.scalars(select(Recording.id)))
        answer = send((path.name, path.read_bytes())).json()
        db.expire_all()
        placed = set(db.scalars(select(SessionSegment.recording_id)))
        homeless = set(db.scalars(select(Recording.id))) - before - placed
        if homeless or not answer.get("proposals"):
            assert any(said in told(answer) for said in NO_SESSION) or answer.get("detail"), path.name
        if "report" not in answer:
            assert answer["detail"], path.name
            continue
        if answer.get("proposals"):
            assert all(p["usable_steps"] for p in answer["proposals"]), path.name
            assert all(u["usable"] or u["reason"] for p in answer["proposals"] for u in p["usable_steps"]), path.name
            joins = {p["session"]["id"] for p in answer["proposals"]} <= known  # the other side of a session that was proposed before
            known |= {p["session"]["id"] for p in answer["proposals"]}
            words = ("Usable steps: ", "The same minutes of this device came before")
            assert joins or any(said in told(answer) for said in words), path.name
        else:
            assert any(report["flagged"] or report["understood"] or report["problem"] for report in answer["report"]), path.name


def test_the_standard_error_of_beta_cannot_drive_a_controller(send: Any, client: TestClient, recordings: Path) -> None:
    (session,) = send(montage(recordings), visit=1, controller="other").json()["sessions"]
    refused = client.patch(f"/api/v1/sessions/{session['id']}", json={"control_stream": "beta_error", "control_channel": "key 2 +9-8"})
    assert refused.status_code == 422
    assert "beta_error" not in refused.json()["hint"]
