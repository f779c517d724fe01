"""A controller's log names the session of the signed plan that it ran. It fills that slot by itself, with what it knows of the draws."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Callable
from datetime import UTC, date, datetime, timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.tables.plans import Plan
from ml.deploy.runtime.decision_log import description_line, kind_line
from tests.app.words import flat

DAY = date(2026, 4, 6)
BOUNDS = {"min_ma": 0.5, "max_ma": 3.0, "cdbs_ma": 3.0, "ramp_ma_per_s": 1.5}
COLUMNS = "t_s,due_s,beta,unit,source,amplitude_ma,action,hold,log_density,ended,battery_percent"


@pytest.fixture
def plan(client: TestClient, study_world: Any, sign_plan: Callable[..., Any], db: Session) -> Plan:
    """A signed plan: a policy, cDBS, a random session, cDBS, the policy again."""
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "design": "stratified"}})
    assert client.patch(f"/api/v1/visits/{study_world.visit}", json={"date": str(DAY), "reason": "agreed"}).status_code == 200
    body = {
        "policy_ids": [study_world.policies[0]],
        "repeats": 2,
        "random_sessions": 1,
        "order": "stated",
        "seed": 1,
        "minutes_per_session": 5,
    }
    drafted = client.post(f"/api/v1/visits/{study_world.visit}/plan", json=body)
    assert drafted.status_code == 201, drafted.text
    assert sign_plan(study_world.visit).status_code == 200
    return db.get_one(Plan, drafted.json()["id"])


def log_of(
    plan: Plan,
    position: int,
    minute: int,
    /,
    *,
    number: int = 0,
    follows: float = 1.0,
    holds: list[tuple[int, int, float, float]] | None = None,
    **said: Any,
) -> str:
    """Write the log of the runner for a session of the plan; sustained draws as (start, steps, fraction, log density).

    Args:
        follows: share of its 151 periods in which the controller decides.
    """
    item = plan.items[position - 1]
    facts = BOUNDS | {
        "policy_id": item.policy_id, "purpose": "session", "participant": "P1", "manifest_sha256": "e" * 64,
        "started_at": (datetime(2026, 4, 6, 9) + timedelta(minutes=minute)).isoformat() + "+00:00",
        "plan_id": plan.id, "slot_id": item.id, "position": position, "repeat": 1, "controller": item.controller,
        "visit_number": 2, "visit_date": str(DAY),
    }  # fmt: skip
    rows = []
    for k in range(-9, 151):
        hold = next((i for i, (start, steps, _, _) in enumerate(holds or []) if start <= k < start + steps), None)
        drawn = "" if hold is None else f"{hold},{holds[hold][3]}" if holds else ""  # type: ignore[index]
        fraction = 1.0 if hold is None or not holds else holds[hold][2]
        action = "policy" if 0 <= k < 151 * follows and (not holds or hold is not None) else "cdbs"
        rows.append(f"{2 * k + 20},{2 * k + 20},{1 + 0.01 * (k % 7) + number},uV,table,{3 * fraction:.6g},{action},{drawn or ','},,")
    return "\n".join([kind_line(2.0), description_line(facts | said), COLUMNS, *rows]) + "\n"


def send(client: TestClient, log: str, code: str = "P1", **stated: str) -> dict[str, Any]:
    answer = client.post("/api/v1/uploads", data={"participant": code, **stated}, files={"file": ("log.csv", log)})
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def test_logs_fill_the_slots_that_they_name_whatever_else_would_explain_them(client: TestClient, study_world: Any, plan: Plan) -> None:
    path = f"/api/v1/visits/{study_world.visit}/slots"
    first, last = [s.position for s in plan.items if s.policy_id]
    send(client, log_of(plan, last, 5, number=1))  # the only log of the policy: by its order it could be the first session of it
    between = next(s.position for s in plan.items if s.controller == "cdbs")
    body = send(client, log_of(plan, between, 40, number=2))
    (found,) = body["proposals"]
    assert (found["session"]["controller"], found["session"]["visit_id"]) == ("cdbs", study_world.visit)
    assert f"its log is of session {between} of the plan of visit 2" in str(found["evidence"])
    rows = {r["position"]: r for r in client.get(path).json()["rows"]}
    assert rows[first]["session_id"] is None
    assert rows[last]["session_id"] is not None
    assert rows[last]["deviations"] == ["out_of_order"], "it ran before cDBS"
    assert between < last
    done = client.post(f"{path}/confirm", json={})
    assert done.status_code == 200, done.text
    held = {r["position"]: r["confirmed"] for r in done.json()["comparison"]["rows"]}
    assert [p for p, confirmed in held.items() if confirmed] == [between, last]


@pytest.mark.parametrize("design", ["stratified", "near"])
def test_the_draws_of_a_random_session_are_those_of_its_log(client: TestClient, study_world: Any, plan: Plan, design: str) -> None:
    position = next(i.position for i in plan.items if i.controller == "random")
    holds = [(0, 60, 0.9, -0.25), (60, 90, 0.7, 0.5)]
    timed = {"n": 200, "mean": 217.0, "std": 33.0, "median": 200.0, "p99": 300.0}
    log = log_of(plan, position, 20, holds=holds, design=design, level=0.8, seed=99, lower_bound=0.45, latency_us=timed)
    send(client, log)
    done = client.post(f"/api/v1/visits/{study_world.visit}/slots/confirm", json={})
    assert done.status_code == 200, done.text
    session = next(r["session_id"] for r in done.json()["comparison"]["rows"] if r["position"] == position)
    found = client.get(f"/api/v1/sessions/{session}/conditions").json()
    assert (found["design"], found["seed"], found["lower_bound"], found["origin"]) == (design, 99, 0.45, "stated")
    kept = found["design_parameters"]
    assert kept["level"] == 0.8
    assert [(h["start"], h["steps"], h["amplitude"], h["log_density"]) for h in kept["holds"]][:2] == [tuple(h) for h in holds]
    for page in (f"/sessions/{session}", f"/visits/{study_world.visit}"):
        assert "0.217" in client.get(page, headers={"Accept": "text/html"}).text, "ms that a decision takes, as the tablet measured"


def test_a_session_in_which_its_policy_seldom_decided_counts_for_none_and_an_aborted_start_fills_no_slot(
    client: TestClient, study_world: Any, plan: Plan
) -> None:
    path, visit = f"/api/v1/visits/{study_world.visit}/slots", f"/visits/{study_world.visit}"
    first, last = [s.position for s in plan.items if s.policy_id]
    send(client, log_of(plan, first, 5, number=1, follows=0.0))
    rows = client.get(path).json()["rows"]
    assert [r["deviations"] for r in rows if r["session_id"]] == [["aborted"]]
    send(client, log_of(plan, first, 25, number=2, attempt=2))
    send(client, log_of(plan, last, 45, number=3, follows=0.4))
    rows = {r["position"]: r for r in client.get(path).json()["rows"]}
    assert [r["deviations"] for r in client.get(path).json()["rows"] if r["position"] is None] == [["aborted"]]
    good, seldom = rows[first]["session_id"], rows[last]["session_id"]
    done = client.post(f"{path}/confirm", json={})
    assert done.status_code == 200, done.text
    said = "its controller decided in 40 % of the periods, cDBS stood in for the rest; below 70 % a session counts for no controller"
    assert any(f"Session {seldom} is excluded: {said}." in note for note in done.json()["notes"])
    assert client.get(f"/api/v1/sessions/{seldom}").json()["excluded_reason"] == said
    assert client.get(f"/api/v1/sessions/{good}").json()["excluded_reason"] is None
    shown = {
        page: flat(client.get(page, headers={"Accept": "text/html"}).text) for page in (visit, f"/sessions/{good}", f"/sessions/{seldom}")
    }
    assert f"session {good} 100 %, session {seldom} 40 %" in shown[visit]
    assert "<dd>100 % " in shown[f"/sessions/{good}"]
    assert "<dd>40 % " in shown[f"/sessions/{seldom}"]
    package = zipfile.ZipFile(io.BytesIO(client.get("/participants/P1/export.zip").content))
    table = {r["session_id"]: r for r in csv.DictReader(io.StringIO(package.read("P1/sessions.csv").decode()))}
    assert [float(table[str(i)]["policy_share"]) for i in (good, seldom)] == [1.0, pytest.approx(0.4, abs=0.005)]
    verdicts = client.get("/api/v1/participants/P1/analyses/primary").json()["verdicts"]
    assert [v["policy_shares"] for v in verdicts] == [[1.0]], "the analyses rest on the other session alone"


def test_a_log_of_another_visit_is_asked_about_and_fills_no_slot_there(client: TestClient, study_world: Any, plan: Plan) -> None:
    other = client.post("/api/v1/participants/P1/visits", json={"number": 9, "date": "2026-05-04"}).json()["id"]
    policy = str(plan.items[0].policy_id)
    body = send(client, log_of(plan, 1, 0), visit="9", controller="rl", policy=policy)
    (found,) = body["proposals"]
    assert found["visit_open"] is True
    assert "the upload says visit 9, and its log is of session 1 of the plan of visit 2" in str(found["evidence"])
    assert client.get(f"/api/v1/visits/{other}/sessions").json()["total"] == 0, "it counts nowhere"
    refused = client.post(f"/api/v1/proposals/{found['session']['id']}/confirm", json={"version": found["version"]})
    assert (refused.status_code, "its visit is open" in refused.json()["detail"]) == (422, True)
    right = client.post(f"/api/v1/proposals/{found['session']['id']}/confirm", json={"version": found["version"], "visit": 2})
    assert right.status_code == 200, right.text
    assert client.get(f"/api/v1/visits/{study_world.visit}/slots").json()["rows"][0]["session_id"] == found["session"]["id"]


def test_a_log_of_a_plan_that_is_not_signed_any_more_is_said_and_stands_beside_the_plan(
    client: TestClient, study_world: Any, plan: Plan, sign_plan: Callable[..., Any]
) -> None:
    again = client.post(
        f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [study_world.policies[1]], "seed": 4, "reason": "another policy"}
    )
    assert again.status_code == 201, again.text
    assert sign_plan(study_world.visit, plan_id=again.json()["id"]).status_code == 200
    body = send(client, log_of(plan, 2, 0))
    assert f"names session 2 of plan {plan.id}, visit 2 (2026-04-06), which is no signed plan" in " ".join(body["report"][0]["flagged"])
    rows = client.get(f"/api/v1/visits/{study_world.visit}/slots").json()["rows"]
    assert [r["deviations"] for r in rows if r["session_id"]] == [["other_plan"]]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"slot_id": 4711}, "which is no signed plan"),
        ({"plan_id": 4711}, "which is no signed plan"),
        ({"position": 2}, "which is no signed plan"),
        ({"purpose": "bench"}, "of a trial on a bench"),
    ],
)
def test_a_log_that_names_no_session_here_fills_none_by_its_name(
    client: TestClient, study_world: Any, plan: Plan, change: dict[str, Any], words: str
) -> None:
    stated = {"visit": "2", "controller": "rl", "policy": str(plan.items[0].policy_id)}
    body = send(client, log_of(plan, 1, 0, **change), **stated)
    assert words in " ".join(body["report"][0]["flagged"])
    assert len(body["proposals"]) == (1 if "purpose" in change else 0), "a trial on a bench never counts at once"
    path = f"/api/v1/visits/{study_world.visit}/slots"
    found = [(r["position"], r["deviations"]) for r in client.get(path).json()["rows"] if r["session_id"]]
    assert found == [(None, ["unplanned" if "purpose" in change else "other_plan"])]
    assert client.post(f"{path}/confirm", json={}).status_code == 409, "there is nothing to confirm into a slot"


@pytest.mark.hazard("H17")
def test_a_slot_that_two_tablets_ran_is_filled_once_and_the_second_log_is_told(client: TestClient, study_world: Any, plan: Plan) -> None:
    for number, minute in ((1, 0), (2, 40)):
        send(client, log_of(plan, 1, minute, number=number))
    path = f"/api/v1/visits/{study_world.visit}/slots"
    found = [(r["position"], r["deviations"]) for r in client.get(path).json()["rows"] if r["session_id"]]
    assert found == [(1, []), (None, ["second_run"])]
    page = client.get(f"/visits/{study_world.visit}/slots", headers={"Accept": "text/html"}).text
    assert "a second run, or a second record of the same one" in page
    assert client.post(f"{path}/confirm", json={}).status_code == 200
    found = [(r["position"], r["confirmed"], r["deviations"]) for r in client.get(path).json()["rows"] if r["session_id"]]
    assert found == [(1, True, []), (None, False, ["second_run"])], "the second one counts nowhere unless somebody confirms it"


def test_the_log_of_a_simulated_device_is_said_to_be_one(client: TestClient, study_world: Any, plan: Plan) -> None:
    body = send(client, log_of(plan, 1, 0, simulated=True))
    assert "is of a simulated device: nobody was stimulated" in " ".join(body["report"][0]["flagged"])
    other = send(client, log_of(plan, 2, 20, number=3))
    assert "simulated" not in str(other["report"])


def test_a_simulated_log_never_counts_for_a_real_participant(client: TestClient, study_world: Any, plan: Plan) -> None:
    log = log_of(plan, 1, 0, simulated=True)
    sent = send(client, log, visit="2", controller="rl")
    assert [s["status"] for s in sent["sessions"]] == ["proposed"], "not even where visit and controller are stated"
    proposal = client.get("/api/v1/participants/P1/proposals").json()[0]
    stated = {"version": proposal["version"], "visit": 2, "controller": "rl"}
    refused = client.post(f"/api/v1/proposals/{proposal['session']['id']}/confirm", json=stated)
    assert (refused.status_code, "real participant" in refused.json()["detail"]) == (422, True), refused.text
    assert client.post(f"/api/v1/visits/{study_world.visit}/slots/confirm", json={}).status_code in (409, 422)
    assert client.get("/api/v1/participants/P1").json()["synthetic"] is False


def test_a_session_that_begins_in_the_future_waits_for_a_person(client: TestClient, study_world: Any, plan: Plan) -> None:
    later = datetime.now(UTC) + timedelta(days=400)
    log = log_of(plan, 1, 0, started_at=later.isoformat())
    sent = send(client, log, visit="2", controller="rl")
    assert [s["status"] for s in sent["sessions"]] == ["proposed"]
    assert "which is in the future" in " ".join(sent["report"][0]["flagged"])


def test_the_page_of_a_visit_shows_its_slots_and_takes_its_logs(
    client: TestClient, client_as: Callable[[str], TestClient], study_world: Any, plan: Plan
) -> None:
    page = {"Accept": "text/html"}
    path = f"/visits/{study_world.visit}"
    before = client.get(path, headers=page).text
    assert f"0 of {len(plan.items)} planned sessions found; " in before, "the day is over, and all are missing"
    assert 'data-after-upload="/visits/' in before
    form = flat(before).split("data-upload ")[1].split("</form>")[0]
    assert 'name="visit" value="2"' in form
    answer = client.post("/participants/P1/upload", data={"visit": "2"}, files={"file": ("log.csv", log_of(plan, 1, 0))}, headers=page)
    assert answer.status_code == 200, "without scripts the form leads to the report of the upload"
    after = client.get(path, headers=page).text
    assert f"1 of {len(plan.items)} planned sessions found" in after
    assert "Confirm 1 session into its slot" in after
    for role, takes in (("coordinator", True), ("viewer", False), ("monitor", False)):
        seen = client_as(role).get(path, headers=page).text
        assert ("data-drop" in seen, "Confirm 1 session" in seen) == (takes, takes), role
        assert "upload.js" not in seen or takes
