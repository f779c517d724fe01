"""After a serious adverse event nothing of a signed plan with that policy starts, until a clinician has cleared or answered it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.platform.errors import Invalid
from app.tablet.command import verified
from app.tablet.live import run_live
from app.tablet.sources import Task
from ml.deploy.runtime.slot import read_withdrawals
from tests.app.planning.bundles.test_slots import policies as policies
from tests.app.planning.bundles.test_slots import signed as signed
from tests.app.planning.bundles.test_slots import taken
from tests.app.planning.serious_events import clear, event

PAGE = {"Accept": "text/html"}
Sign = Callable[..., Any]
ANSWERED = "the fall was a stumble over a cable"


def warned(client: TestClient, visit: int) -> list[tuple[int | None, str]]:
    plan = client.get(f"/api/v1/visits/{visit}/plan").json()
    return [(w["policy_id"], w["text"]) for w in plan["warnings"] if w["code"] == "adverse_event"]


@pytest.mark.hazard("H24")
def test_nothing_of_a_signed_plan_starts_after_a_serious_event_until_it_is_cleared(
    client: TestClient, study_world: Any, signed: dict[str, Any], policies: list[int], tmp_path: Path
) -> None:
    position = next(s["position"] for s in signed["sessions"] if s["policy_id"] == policies[0])
    other = next(s["position"] for s in signed["sessions"] if s["policy_id"] == policies[1])
    day, plan, own = f"/visit-day/{study_world.visit}", f"/visits/{study_world.visit}/plan", f"/api/v1/policies/{policies[0]}/bundle"
    event(client, study_world.policies[0])
    bundle = tmp_path / "bundle.zip"
    answer = taken(client, study_world.visit, position)
    assert answer.status_code == 200, "an event under a policy that the plan does not have"
    bundle.write_bytes(answer.content)
    key, listed = client.get("/api/v1/bundle-key").text.strip(), tmp_path / "withdrawn.txt"

    def withdrawn() -> frozenset[int]:
        listed.write_bytes(client.get("/api/v1/bundle-withdrawals").content)
        return read_withdrawals(listed, bytes.fromhex(key)).plans

    assert (withdrawn(), warned(client, study_world.visit)) == (frozenset(), [])
    found = event(client, policies[0])
    words = f"adverse event {found['id']} under policy 'net-1' is serious, and no clinician has cleared it"
    for path in (f"/api/v1/visits/{study_world.visit}/plan/sessions/{position}/bundle", own):
        refused = client.get(path)
        assert (refused.status_code, words in refused.json()["detail"]) == (409, True), refused.text
        assert "Clear the event with a reason" in refused.json()["hint"]
    assert taken(client, study_world.visit, other).status_code == 409, "the plan as a whole, so that none tells which session is whose"
    assert client.get(f"/api/v1/policies/{policies[1]}/bundle").status_code == 200
    ((policy, text),) = warned(client, study_world.visit)
    assert (policy, words in text) == (policies[0], True)
    shown = (plan, day, f"/visits/{study_world.visit}/bundles", f"/participants/P1/policies/{policies[0]}/bundle")
    for path in shown:
        assert words in client.get(path, headers=PAGE).text.replace("&#39;", "'"), path
    assert "Nothing may be started." in client.get(day, headers=PAGE).text
    assert withdrawn() == {signed["id"]}
    task = Task(log=tmp_path / "log.csv", key=key, ledger=tmp_path / "ledger", withdrawn=listed)
    with pytest.raises(Invalid, match=f"plan {signed['id']} was replaced or withdrawn"):
        run_live(verified(bundle, key), bundle.name, "simulated:P1", task)
    clear(client, found)
    assert (withdrawn(), warned(client, study_world.visit)) == (frozenset(), [])
    assert [client.get(own).status_code, taken(client, study_world.visit, position).status_code] == [200, 200]
    for path in shown:
        assert "is serious, and no clinician" not in client.get(path, headers=PAGE).text, path


@pytest.mark.hazard("H24")
def test_a_reason_answers_the_events_that_were_known_when_it_was_given_and_no_later_ones(
    client: TestClient, study_world: Any, signed: dict[str, Any], policies: list[int], sign_plan: Sign
) -> None:
    path, own = f"/api/v1/visits/{study_world.visit}/plan", f"/api/v1/policies/{policies[0]}/bundle"

    def drafted(reason: str) -> None:
        override = [{"policy_id": policies[0], "reason": reason}]
        answer = client.post(path, json={"policy_ids": [policies[0]], "overrides": override, "min_ma": 0.5, "reason": "an event"})
        assert answer.status_code == 201, answer.text

    event(client, policies[0])
    drafted(ANSWERED)
    assert (client.get(own).status_code, warned(client, study_world.visit)) == (409, []), "a draft answers for nothing that runs"
    assert sign_plan(study_world.visit).status_code == 200
    assert [client.get(own).status_code, taken(client, study_world.visit, 1).status_code] == [200, 200]
    event(client, policies[0])
    assert [client.get(own).status_code, taken(client, study_world.visit, 1).status_code] == [409, 409]
    drafted("both falls were stumbles")
    third = event(client, policies[0])
    unsigned = sign_plan(study_world.visit)
    assert (unsigned.status_code, f"may not be signed: adverse event {third['id']}" in unsigned.json()["detail"]) == (409, True)
    drafted("all three were stumbles")
    assert sign_plan(study_world.visit).status_code == 200
    assert [client.get(own).status_code, taken(client, study_world.visit, 1).status_code] == [200, 200]
    change = {"kind": "fall", "severity": "severe", "serious": True, "note": "broke a hip", "revision": 1, "reason": "X-ray"}
    assert client.put(f"/api/v1/adverse-events/{third['id']}", json=change).status_code == 200
    assert taken(client, study_world.visit, 1).status_code == 409, "who gave the reason knew less"


@pytest.mark.hazard("H24")
def test_a_sealed_plan_says_that_it_may_not_run_and_neither_policy_nor_event(
    client: TestClient, study_world: Any, signed: dict[str, Any], policies: list[int], sign_plan: Sign
) -> None:
    wanted = {"policy_ids": policies, "min_ma": 0.5, "minutes_per_session": 5, "blinded": True, "reason": "blinded"}
    assert client.post(f"/api/v1/visits/{study_world.visit}/plan", json=wanted).status_code == 201
    assert sign_plan(study_world.visit).status_code == 200
    assert taken(client, study_world.visit, 1).status_code == 200
    paths = (f"/visits/{study_world.visit}/plan", f"/visits/{study_world.visit}/bundles", f"/visit-day/{study_world.visit}")
    before = [client.get(path, headers=PAGE).text for path in paths]
    for policy in policies:
        event(client, policy)
    words = "a serious adverse event or a stop, which no clinician has cleared, stands against a policy of it"
    refused = taken(client, study_world.visit, 1)
    assert (refused.status_code, words in refused.json()["detail"]) == (409, True)
    ((policy, text),) = warned(client, study_world.visit)
    assert (policy, words in text) == (None, True)
    page, bundles, day = after = [client.get(path, headers=PAGE).text for path in paths]
    assert words in page
    assert words in bundles
    assert "This plan may not run any more." in day
    # the plan's page names every policy that no ranking holds, of the plan or not
    assert [told.count("net-") for told in after] == [told.count("net-") for told in before]
    assert not [told for told in (refused.text, text, *after) if "adverse event 1" in told or "adverse event 2" in told]
    assert "net-" not in refused.text + text
