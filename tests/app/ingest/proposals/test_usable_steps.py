"""Usable steps are told with the upload, by channel, with the reason where there are none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fastapi.testclient import TestClient


def told(answer: dict[str, Any]) -> str:
    return " ".join(line for report in answer["report"] for line in (*report["understood"], *report["flagged"]))


def montage(recordings: Path) -> tuple[str, bytes]:
    return "m.zip", (recordings / "rcs" / "montage_packet_loss.zip").read_bytes()


def test_a_recording_with_packet_loss_has_20_usable_time_domain_steps(send: Any, client: TestClient, recordings: Path) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 3.0}})
    answer = send(montage(recordings)).json()
    (proposal,) = answer["proposals"]
    first, *rest = proposal["usable_steps"]
    # of the subthalamic lead, though a channel of motor cortex has more valid steps
    assert (first["channel"], first["source"], first["is_control"]) == ("key 1 +3-1", "time_domain", True)
    # three configurations that were sensed one after another
    found = {u["channel"]: u["usable"] for u in proposal["usable_steps"]}
    assert [found["key 0 +2-0"], found["key 2 +9-8"], found["key 2 +11-9"]] == [4, 18, 3]
    assert first["reason"] is None
    # five configurations of 20 steps, of which the first ten are a state's window: no channel that was sensed in one alone can have more
    assert proposal["usable_on_any"] == 25
    assert "; 25 on one time-domain channel or another, which were sensed one after another; " in told(answer)
    assert len(rest) == 12
    assert all((u["reason"] is None) == (u["usable"] > 0) for u in rest)
    assert f"Usable steps: {first['usable']} of 103 on beta key 1 +3-1" in told(answer)
    page = client.get(f"/proposals/{proposal['session']['id']}", headers={"Accept": "text/html"}).text
    assert "Steps that can be learned from, of 103" in page
    assert f"<td>{first['usable']}</td>" in page


def test_without_imputed_values_there_are_fewer_and_the_reason_names_the_gaps(send: Any, client: TestClient, recordings: Path) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 3.0, "most_imputed": 0}})
    (proposal,) = send(montage(recordings)).json()["proposals"]
    found = {u["channel"]: u for u in proposal["usable_steps"]}
    assert found["key 2 +9-8"]["usable"] < 20
    assert found["key 0 +2-0"]["reason"] == ("its 17 valid steps are nowhere 11 in a row without a gap, as a state and its next beta need")


def every(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def test_every_recording_shows_its_usable_steps_or_says_why_it_has_none(send: Any, client: TestClient, recordings: Path) -> None:
    for path in every(recordings):
        answer = send((path.name, path.read_bytes())).json()
        if "report" not in answer:
            assert answer["detail"], path.name
            continue
        if answer["proposals"]:
            assert all(u["usable"] or u["reason"] for p in answer["proposals"] for u in p["usable_steps"]), path.name
            assert "Usable steps: " in told(answer) or "The same minutes of this device came before" in told(answer), path.name
        else:
            assert any(report["flagged"] or report["understood"] for report in answer["report"]), path.name


def test_the_standard_error_of_beta_cannot_drive_a_controller(send: Any, client: TestClient, recordings: Path) -> None:
    (session,) = send(montage(recordings), visit=1, controller="other").json()["sessions"]
    refused = client.patch(f"/api/v1/sessions/{session['id']}", json={"control_stream": "beta_error", "control_channel": "key 2 +9-8"})
    assert refused.status_code == 422
    assert "beta_error" not in refused.json()["hint"]
