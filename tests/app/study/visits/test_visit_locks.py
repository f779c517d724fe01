"""Visits are locked and unlocked with a reason; blinded assessors learn what ran once a visit is locked."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient

from app.accounts.permissions import is_open
from tests.conftest import PASSWORD

Upload = Callable[..., int]
Clients = Callable[[str], TestClient]


def lock(client: TestClient, visit: int = 1, what: str = "lock", reason: str = "data complete"):  # type: ignore[no-untyped-def]
    visits = client.get("/api/v1/participants/P1/visits").json()["items"]
    number = next(v["id"] for v in visits if v["number"] == visit)
    body = {"reason": reason} | ({"password": PASSWORD} if what == "lock" else {})
    return client.post(f"/api/v1/visits/{number}/{what}", json=body)


def test_a_locked_visit_takes_no_change_until_it_is_unlocked_with_a_reason(client: TestClient, upload: Upload) -> None:
    session = upload("cdbs")
    visit = client.get(f"/api/v1/sessions/{session}").json()["visit_id"]
    assert lock(client).status_code == 200
    refused = [
        client.put(f"/api/v1/sessions/{session}/qoc", json={"rating": 2, "reason": "x"}),
        client.patch(f"/api/v1/sessions/{session}", json={"excluded_reason": "cable", "reason": "x"}),
        client.patch(f"/api/v1/sessions/{session}", json={"stopped_reason": "dyskinesia", "reason": "x"}),
        client.put(f"/api/v1/sessions/{session}/conditions", json={"lower_bound": 0.5, "reason": "x"}),
        client.post(f"/sessions/{session}/conditions", data={"revision": "1", "lower_bound": "0.5", "conditions_reason": "x"}),
        client.patch(f"/api/v1/visits/{visit}", json={"note": "x", "reason": "x"}),
        client.patch(f"/api/v1/visits/{visit}", json={"cdbs_amplitudes": [{"hemisphere": "left", "amplitude_ma": 2.0}], "reason": "x"}),
        client.post(f"/api/v1/visits/{visit}/doses", json={"drug": "levodopa", "mg": 100, "taken_at": "2026-03-02T07:00:00Z"}),
    ]
    assert [r.status_code for r in refused] == [409] * len(refused)
    assert client.get(f"/api/v1/visits/{visit}/locks").json()[-1]["signature_state"] == "stands"
    assert client.get(f"/api/v1/sessions/{session}/conditions").json()["revision"] == 1
    assert "was locked by admin@clinic.example" in refused[0].json()["detail"]
    assert lock(client).status_code == 409
    assert client.post(f"/api/v1/visits/{visit}/unlock", json={"reason": ""}).status_code == 422
    assert lock(client, what="unlock", reason="rating misread").status_code == 200
    assert client.put(f"/api/v1/sessions/{session}/qoc", json={"rating": 2, "reason": "x"}).status_code == 200
    history = client.get(f"/api/v1/visits/{visit}/locks").json()
    assert [(h["locked"], h["reason"]) for h in history] == [(True, "data complete"), (False, "rating misread")]
    assert "rating misread" in client.get("/audit?entity=visit_lock").text


def test_uploads_that_would_count_in_a_locked_visit_are_refused(client: TestClient, upload: Upload) -> None:
    upload("cdbs")
    lock(client)
    with pytest.raises(AssertionError, match="locked"):
        upload("rl", level=0.6)


def test_the_page_of_a_visit_locks_and_unlocks(client: TestClient, upload: Upload, client_as: Clients) -> None:
    session = upload("cdbs")
    visit = client.get(f"/api/v1/sessions/{session}").json()["visit_id"]
    assert "Lock this visit" in client.get(f"/visits/{visit}").text
    done = client.post(f"/visits/{visit}/lock", data={"lock_reason": "complete", "password": PASSWORD}, follow_redirects=False)
    assert done.status_code == 303
    assert "Unlock this visit" in client.get(f"/visits/{visit}").text
    engineer = client_as("engineer")
    assert "Unlock this visit" not in engineer.get(f"/visits/{visit}").text
    assert engineer.post(f"/api/v1/visits/{visit}/unlock", json={"reason": "x"}).status_code == 403


def test_a_blinded_assessor_learns_what_ran_once_the_visit_is_locked(client: TestClient, upload: Upload, client_as: Clients) -> None:
    sessions = [upload("cdbs"), upload("rl", level=0.6)]
    blinded = client_as("blinded_assessor")
    visit = blinded.get("/api/v1/participants/P1/visits").json()["items"][0]["id"]
    assert [s["controller"] for s in blinded.get(f"/api/v1/visits/{visit}/sessions").json()["items"]] == [None, None]
    assert blinded.get(f"/api/v1/sessions/{sessions[1]}/trace").status_code == 403
    assert blinded.get(f"/sessions/{sessions[1]}").status_code == 403
    before = blinded.get("/api/v1/participants/P1/analyses").json()
    assert (before["controllers"], [e["reason"] for e in before["excluded"]]) == ([], ["hidden from you until its visit is locked"] * 2)
    assert blinded.get("/api/v1/participants/P1/analyses/primary").json()["results"] == []
    for path in (
        "/",
        "/participants/P1",
        "/participants/P1/visits",
        f"/visits/{visit}",
        "/participants/P1/analyses",
        "/analyses",
        "/trial-time",
    ):
        page = blinded.get(path)
        assert page.status_code == 200, path
        assert 'class="controller' not in page.text, path
    assert lock(client).status_code == 200
    assert [s["controller"] for s in blinded.get(f"/api/v1/visits/{visit}/sessions").json()["items"]] == ["cdbs", "rl"]
    assert [c["controller"] for c in blinded.get("/api/v1/participants/P1/analyses").json()["controllers"]] == ["cdbs", "rl"]
    assert blinded.get(f"/api/v1/sessions/{sessions[1]}/trace").status_code == 200
    lock(client, what="unlock", reason="correction")
    assert blinded.get("/api/v1/participants/P1/analyses").json()["controllers"] == []


def test_a_blinded_assessor_enters_qocs_without_the_controller(client: TestClient, upload: Upload, client_as: Clients) -> None:
    session = upload("rl", level=0.6, qoc={})
    blinded = client_as("blinded_assessor")
    done = blinded.post(f"/sessions/{session}/qoc", data={"revision": "0", "rating": "6"}, follow_redirects=False)
    assert (done.status_code, done.headers["location"].startswith("/visits/")) == (303, True)
    assert client.get(f"/api/v1/sessions/{session}/qoc").json()["rating"] == 6
    wrong = blinded.post(f"/sessions/{session}/qoc", data={"revision": "1", "rating": "60"})
    assert wrong.status_code == 422
    assert 'class="controller' not in wrong.text


def test_whatever_is_not_listed_is_closed_to_blinded_assessors(client: TestClient, upload: Upload, client_as: Clients) -> None:
    session = upload("rl", level=0.6)
    blinded = client_as("blinded_assessor")
    visit = client.get(f"/api/v1/sessions/{session}").json()["visit_id"]
    for path in ("ranking", "snapshots", "policies", "jobs", "proposals", "calibration", "margins"):
        assert blinded.get(f"/api/v1/participants/P1/{path}").status_code == 403, path
    assert blinded.get(f"/visits/{visit}/plan").status_code == 403
    assert blinded.get("/participants/P1/export.zip").status_code == 403
    assert not is_open("GET", "/participants/P1/some-new-page")
    assert client.get("/participants/P1").status_code == 200


def test_nothing_open_to_a_blinded_assessor_depends_on_which_controller_ran(
    client: TestClient, service_app: FastAPI, upload: Upload, client_as: Clients
) -> None:
    """Every open page and route answers the same where the arms of two sessions of an unlocked visit change places."""
    sessions = [upload("cdbs"), upload("rl")]
    visit = client.get(f"/api/v1/sessions/{sessions[0]}").json()["visit_id"]
    blinded = client_as("blinded_assessor")
    blinded.get("/account")
    named = {"code": "P1", "visit_id": visit, "key": "rl"}
    paths = {
        context.path.format(**named, session_id=session)
        for context in iter_route_contexts(service_app.routes)
        for session in sessions
        if context.path
        and "GET" in (getattr(context, "methods", None) or ())
        and set(re.findall(r"{(\w+)", context.path)) <= {*named, "session_id"}
    }
    opened = sorted(p for p in paths if is_open("GET", p))
    assert len(opened) > 40

    def answers(caller: TestClient) -> dict[str, str]:
        changing = r'"request_id":"\w+"|name="csrf[^>]*>|nonce-?="?[\w-]+'
        return {p: re.sub(changing, "", caller.get(p).text) for p in opened if p != "/account"}

    seen, known = answers(blinded), answers(client)
    for session, controller in zip(sessions, ("rl", "cdbs"), strict=True):
        body = {"controller": controller, "reason": "swapped"}
        assert client.patch(f"/api/v1/sessions/{session}", json=body).status_code == 200
    again = answers(client)
    assert sum(known[p] != again[p] for p in opened if p in known) >= 5, "the swap shows to those who may know"
    now = answers(blinded)
    assert [p for p in seen if seen[p] != now[p]] == []
