"""Margins against cDBS: versioned, changed by a clinician with a reason, and bounded."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.platform.database import transaction
from app.study import repository
from app.study.margins import BOUNDS, margins_of
from ml.qoc import Margins
from tests.conftest import PASSWORD

HTML = {"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}
PATH = "/api/v1/participants/P1/margins"
DEFAULTS = {
    "grasp_share": 0.1, "rating_points": 1.0, "tremor_points": 10.0, "test_within": 0.8, "test_saves": 0.9, "unsafe_beyond": 0.9,
    "nearly_off_share": 0.2,
}  # fmt: skip


def test_a_new_participant_has_the_stated_defaults(client: TestClient, participant_code: str) -> None:
    (only,) = client.get(PATH).json()
    assert {name: only[name] for name in DEFAULTS} == DEFAULTS
    assert (only["version"], only["reason"]) == (1, None)
    assert Margins() == Margins(0.1, 1.0, 10.0)


def test_a_change_is_a_new_version_and_leaves_the_old_one(client: TestClient, participant_code: str, db: Session) -> None:
    sent = {"margins": {"tremor_points": 5}, "reason": "she fears tremor most"}
    assert client.put(PATH, json=sent).json()["version"] == 2
    assert client.put(PATH, json=sent).json()["version"] == 2, "the same again makes no version"
    first, second = client.get(PATH).json()
    assert (first["tremor_points"], second["tremor_points"]) == (10.0, 5.0)
    assert second["rating_points"] == 1.0, "what is left out keeps its value"
    assert second["reason"] == "she fears tremor most"
    with transaction("test") as session:
        (participant,), _ = repository.participants(session, SYSTEM, 1, 0)
        assert margins_of(participant.current_margins) == Margins(0.1, 1.0, 5.0)
    with pytest.raises(DBAPIError, match=r"never change|permission denied"):
        db.execute(text("update margins_version set tremor_points = 50"))


def test_a_change_needs_its_reason(client: TestClient, participant_code: str) -> None:
    answer = client.put(PATH, json={"margins": {"tremor_points": 5}, "reason": "  "})
    assert (answer.status_code, "reason" in answer.json()["detail"]) == (422, True)
    assert len(client.get(PATH).json()) == 1


@pytest.mark.parametrize("name", sorted(BOUNDS))
def test_what_cannot_be_a_margin_is_refused_with_its_bounds(client: TestClient, participant_code: str, name: str) -> None:
    for value in (-0.1, BOUNDS[name].high * 1.01):
        answer = client.put(PATH, json={"margins": {name: value}, "reason": "a slip"})
        assert answer.status_code == 422
        assert f"must lie between {BOUNDS[name].low:g} and {BOUNDS[name].high:g}" in answer.text
    assert len(client.get(PATH).json()) == 1


def test_the_page_changes_what_was_typed_and_keeps_what_was_refused(client: TestClient, participant_code: str) -> None:
    page = "/participants/P1/margins"
    refused = client.post(page, data={"version": "1", "tremor_points": "500", "reason": "r"}, headers=HTML)
    assert refused.status_code == 422
    assert "must lie between 0.5 and 50 percentage points" in refused.text
    assert 'value="500"' in refused.text
    done = client.post(page, data={"version": "1", "tremor_points": "6", "reason": "agreed"}, headers=HTML, follow_redirects=False)
    assert done.headers["location"].endswith("?done=changed")
    assert client.get(PATH).json()[-1]["tremor_points"] == 6.0
    old = client.post(page, data={"version": "1", "tremor_points": "8", "reason": "late"}, headers=HTML)
    assert old.status_code == 409, "a form opened before somebody else's change does not take it back"


def test_the_page_says_which_visits_only_explore(client: TestClient, participant_code: str) -> None:
    page = "/participants/P1/margins"
    assert "only explore" not in client.get(page, headers=HTML).text
    locked = client.post(f"{PATH}/locks", json={"version": 1, "reason": "protocol", "password": PASSWORD})
    assert locked.status_code == 201, locked.text
    assert "visits that began before the first lock only explore" in client.get(page, headers=HTML).text
