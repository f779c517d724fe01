"""A session of several recordings is judged by all of them: a side without a controller may have been stimulated all the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.app.ingest.conftest import device_zip, steady
from tests.app.ingest.proposals.test_proposals import correct, post
from tests.app.words import flat


@pytest.fixture
def percept(recordings: Path) -> tuple[str, bytes]:
    """A report of four streaming runs: the right side is sensed and silent, the left has 3.1 mA in the first three."""
    return "report.zip", (recordings / "percept" / "percept_session_report.zip").read_bytes()


def page(client: TestClient, path: str) -> str:
    return client.get(path, headers={"Accept": "text/html"}).text


def notes_of(report: list[dict[str, Any]]) -> str:
    return " ".join(s for r in report for s in r["flagged"])


def test_a_silent_side_beside_a_stimulated_one_is_no_session_without_dbs(send: Any, percept: tuple[str, bytes]) -> None:
    made = send(percept, visit=1).json()["proposals"]
    assert [p["session"]["controller"] for p in made] == [None, None, None, "no_dbs"]
    assert {p["session"]["hemisphere"] for p in made} == {"right"}
    for p in made[:3]:
        why = p["evidence"]["controller"]
        assert "right side: the amplitude is 0 in all" in why
        assert "left side: about 3.1 mA throughout" in why
    assert "left side: the amplitude is 0 in all 68 steps" in made[3]["evidence"]["controller"]


def test_the_report_says_which_side_is_taken_for_the_controlled_one(send: Any, percept: tuple[str, bytes]) -> None:
    said = " ".join(send(percept, visit=1).json()["report"][0]["understood"])
    assert "controlled by beta ONE_THREE_RIGHT of the right side, recorded together with the left side" in said


def test_a_confirmed_no_dbs_with_a_stimulated_side_is_told_at_once_and_on_its_page(
    send: Any, client: TestClient, percept: tuple[str, bytes]
) -> None:
    (first, *_) = send(percept, visit=1).json()["proposals"]
    notes = post(client, first, "confirm", controller="no_dbs").json()["notes"]
    against = "Said to be without DBS, but its mean amplitude on the left side is 103 % of the cDBS amplitude"
    assert any(against in n for n in notes)
    assert against in page(client, f"/sessions/{first['session']['id']}")


def test_the_page_says_whose_stimulation_is_not_in_its_energy(send: Any, client: TestClient, percept: tuple[str, bytes]) -> None:
    first, *_, last = send(percept, visit=1).json()["proposals"]
    for one, said in ((first, "left side"), (last, None)):
        post(client, one, "confirm", controller="no_dbs")
        text = flat(page(client, f"/sessions/{one['session']['id']}"))
        assert ("<dt>Stimulated too</dt>" in text) is (said is not None)
        assert said is None or f"<dt>Stimulated too</dt><dd>{said} " in text
    alone = send(("a.zip", device_zip()), visit=1, controller="random").json()["sessions"][0]["id"]
    assert "<dt>Stimulated too</dt>" not in page(client, f"/sessions/{alone}"), "its own stimulation is what its energy is of"


def test_a_stated_controller_is_held_against_every_side(send: Any, percept: tuple[str, bytes]) -> None:
    answer = send(percept, visit=1, controller="no_dbs").json()
    (line,) = [text for text in answer["report"][0]["flagged"] if "Said to be without DBS, but its mean amplitude on the left side" in text]
    assert line.endswith("(3×)"), "one line for the three sessions"


def test_cdbs_with_a_silent_side_is_neither_proposed_nor_taken_without_a_word(
    send: Any, client: TestClient, percept: tuple[str, bytes]
) -> None:
    (first, *_) = send(percept, visit=1, hemisphere="left").json()["proposals"]
    assert first["session"]["controller"] is None
    notes = post(client, first, "confirm", controller="cdbs").json()["notes"]
    assert any("Said to be cDBS, but its mean amplitude on the right side is 0 % of the cDBS amplitude" in n for n in notes)


def test_a_visit_that_states_cdbs_for_one_side_expects_none_on_the_other(send: Any, client: TestClient, percept: tuple[str, bytes]) -> None:
    body = {"number": 2, "date": "2024-03-14", "cdbs_amplitudes": [{"hemisphere": "left", "amplitude_ma": 3.1}]}
    assert client.post("/api/v1/participants/P1/visits", json=body).status_code == 201
    (first, *_) = send(percept, hemisphere="left").json()["proposals"]
    notes = post(client, first, "confirm", controller="cdbs").json()["notes"]
    assert not any("Said to be cDBS" in n for n in notes)


def test_an_adaptive_session_whose_controlled_side_was_off_is_told(send: Any, client: TestClient, percept: tuple[str, bytes]) -> None:
    (first, *_) = send(percept, visit=1).json()["proposals"]
    notes = post(client, first, "confirm", controller="random").json()["notes"]
    assert any("The controlled right side had no stimulation, while the left side had" in n for n in notes)


def test_a_guess_follows_the_correction_that_it_rests_on(send: Any, client: TestClient) -> None:
    body = {"number": 2, "date": "2026-03-30", "cdbs_amplitudes": [{"hemisphere": "right", "amplitude_ma": 1.5}]}
    assert client.post("/api/v1/participants/P1/visits", json=body).status_code == 201
    (proposal,) = send(("t.csv", steady(3.0, amplitude="amplitude_ma")), visit=1).json()["proposals"]
    assert proposal["session"]["controller"] == "cdbs"
    moved = correct(client, proposal, visit=2, hemisphere="right").json()
    assert moved["session"]["controller"] is None
    assert "200 % of the cDBS amplitude" in moved["evidence"]["controller"]
    back = correct(client, moved, visit=1).json()
    assert back["session"]["controller"] == "cdbs"


def test_what_a_person_stated_outlives_every_correction_and_says_whose_word_it_is(send: Any, client: TestClient) -> None:
    (proposal,) = send(("t.csv", steady(1)), visit=1).json()["proposals"]
    said = correct(client, proposal, controller="random").json()
    assert said["evidence"]["controller"] == "as stated by admin@clinic.example"
    assert correct(client, said, hemisphere="left").json()["session"]["controller"] == "random"


def test_a_controller_that_a_person_opened_again_is_not_guessed_back(send: Any, client: TestClient) -> None:
    (proposal,) = send(("t.csv", steady(1)), visit=1).json()["proposals"]
    opened = correct(client, proposal, controller=None).json()
    assert (opened["session"]["controller"], opened["evidence"]["controller"]) == (None, "as stated by admin@clinic.example: open")
    assert correct(client, opened, stop_s=20).json()["session"]["controller"] is None


def test_a_counting_upload_that_joins_a_proposal_is_told_that_it_does_not_count(send: Any, proposals: Any) -> None:
    send(("right.zip", device_zip(("random",), "P1")))
    answer = send(("left.zip", device_zip(("random",), "P2")), visit=1, controller="random").json()
    assert "which counts nowhere until it is confirmed: it belongs to that session" in " ".join(answer["report"][0]["understood"])
    assert "was not changed: its controller is still open, not random" in notes_of(answer["report"])
    assert len(proposals()) == 1


def test_a_side_that_is_not_the_recordings_is_told_in_report_and_page(send: Any, client: TestClient, recordings: Path) -> None:
    sweep = ("s.zip", (recordings / "rcs" / "stim_sweep.zip").read_bytes())
    answer = send(sweep, visit=1, controller="other", hemisphere="left").json()
    against = "Said to be controlled on the left side, but its control trace is of recording"
    assert against in notes_of(answer["report"])
    shown = page(client, f"/sessions/{answer['sessions'][0]['id']}")
    assert against in shown
    assert "which is of the right side" in shown


def test_the_session_page_shows_what_the_upload_flagged(send: Any, client: TestClient) -> None:
    answer = send(("t.csv", steady(0.37)), visit=1, controller="cdbs").json()
    against = "Said to be cDBS, but its mean amplitude is 37 % of the cDBS amplitude"
    assert against in notes_of(answer["report"])
    assert against in page(client, f"/sessions/{answer['sessions'][0]['id']}")
    fine = send(("u.csv", steady(1)), visit=1, controller="cdbs").json()
    assert "Look at this" not in page(client, f"/sessions/{fine['sessions'][0]['id']}")


def test_the_other_implant_joins_a_session_that_was_confirmed_before_it_came(send: Any, client: TestClient, proposals: Any) -> None:
    first = send(("right.zip", device_zip(("random",), "P1")), visit=1, controller="random").json()["sessions"][0]
    before = client.get(f"/api/v1/sessions/{first['id']}/trace").json()
    answer = send(("left.zip", device_zip(("random",), "P2")), visit=1, controller="random").json()
    assert [s["id"] for s in answer["sessions"]] == [first["id"]]
    assert "added to it beside its controlled recording (right side)" in " ".join(answer["report"][0]["understood"])
    assert proposals() == []
    assert client.get(f"/api/v1/sessions/{first['id']}/trace").json() == before
    assert len(answer["sessions"][0]["recordings"]) == 2


def test_what_is_said_with_the_other_implant_and_is_not_so_is_told(send: Any) -> None:
    first = send(("right.zip", device_zip(("random",), "P1")), visit=1, controller="random").json()["sessions"][0]
    answer = send(("left.zip", device_zip(("random",), "P2")), visit=1, controller="cdbs", hemisphere="left").json()
    told = notes_of(answer["report"])
    assert f"Session {first['id']} was not changed: its controller is random, not cdbs" in told
    assert "it is controlled on the right side, not the left" in told


@pytest.mark.parametrize("start", ["2019-08-16T19:35:00Z", "2019-08-15T12:00:00Z"])
def test_a_stated_start_outside_the_recording_is_refused_and_said(send: Any, client: TestClient, recordings: Path, start: str) -> None:
    client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2019-08-15"})
    sweep = ("s.zip", (recordings / "rcs" / "stim_sweep.zip").read_bytes())
    answer = send(sweep, visit=2, controller="other", started_at=start).json()
    assert answer["sessions"][0]["started_at"].startswith("2019-08-15T19:33:1")
    told = notes_of(answer["report"])
    assert f"The stated start {start[:10]} {start[11:19]} UTC does not lie in this recording (2019-08-15 19:33:1" in told
    assert "but visit 2 is dated" not in told


def test_a_recording_belongs_to_the_visit_of_its_local_day(send: Any, client: TestClient, recordings: Path) -> None:
    client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2019-07-16"})
    montage = ("m.zip", (recordings / "rcs" / "montage_packet_loss.zip").read_bytes())
    (proposal,) = send(montage).json()["proposals"]
    assert proposal["session"]["started_at"].startswith("2019-07-17T00:25")
    assert (proposal["session"]["visit"], proposal["visit_open"]) == (2, False)
    notes = post(client, proposal, "confirm", controller="other").json()["notes"]
    assert not any("Recorded on" in n for n in notes)


def test_the_control_channel_is_one_of_the_deep_target_that_can_teach_most(send: Any, client: TestClient, recordings: Path) -> None:
    montage = ("m.zip", (recordings / "rcs" / "montage_packet_loss.zip").read_bytes())
    (session,) = send(montage, visit=1, controller="other").json()["sessions"]
    trace = client.get(f"/api/v1/sessions/{session['id']}/trace").json()
    assert session["control_channel"] == "key 1 +3-1", "11 usable steps of the STN; channels of motor cortex have more"
    assert sum(b is not None for b, t in zip(trace["beta"], trace["t_s"], strict=True) if t > 0) == 34
