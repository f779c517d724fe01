"""A visit made of the day of a recording, in one step for every proposal of that day."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.app.ingest.conftest import device_zip, steady

NOON_NEXT_DAY = 26 * 60.0
"""Minutes after the first recording's start, which is on the day of visit 1."""


def add(client: TestClient, proposal: dict[str, Any], version: int | None = None) -> Any:
    body = {"version": version or proposal["version"]}
    return client.post(f"/api/v1/proposals/{proposal['session']['id']}/visit", json=body)


def test_a_visit_takes_every_open_proposal_of_its_day_and_no_other(client: TestClient, send: Any, proposals: Any) -> None:
    (known,) = send(("a.zip", device_zip(("cdbs",)))).json()["proposals"]
    for name, minute in (("b.zip", NOON_NEXT_DAY), ("c.zip", NOON_NEXT_DAY + 30), ("d.zip", 2 * NOON_NEXT_DAY)):
        answer = send((name, device_zip(("cdbs",), minute=minute, seed=int(minute))))
        assert answer.status_code == 201, answer.text
        assert [p["visit_open"] for p in answer.json()["proposals"]] == [True]
    first, second, later = [p for p in proposals() if p["visit_open"]]
    made = add(client, first)
    assert made.status_code == 201, made.text
    assert (made.json()["visit"]["number"], made.json()["visit"]["date"]) == (2, "2026-03-03")
    told = {p["session"]["id"]: (p["session"]["visit"], p["visit_open"], p["evidence"]["visit"]) for p in made.json()["proposals"]}
    why = "recorded on 2026-03-03, the day of visit 2"
    assert told == {p["session"]["id"]: (2, False, why) for p in (first, second)}
    after = {p["session"]["id"]: (p["session"]["visit"], p["visit_open"]) for p in proposals()}
    assert after[known["session"]["id"]] == (1, False)
    assert after[later["session"]["id"]][1]
    # forms that were open do not overwrite it
    assert client.patch(f"/api/v1/proposals/{second['session']['id']}", json={"version": second["version"], "visit": 1}).status_code == 409


def test_what_has_a_visit_or_no_date_makes_none(client: TestClient, send: Any) -> None:
    (known,) = send(("a.zip", device_zip(("cdbs",)))).json()["proposals"]
    assert add(client, known).status_code == 422
    (undated,) = send(("t.csv", steady(0))).json()["proposals"]
    assert "states no date" in add(client, undated).json()["detail"]
    (open_one,) = send(("b.zip", device_zip(("cdbs",), minute=NOON_NEXT_DAY))).json()["proposals"]
    assert add(client, open_one, version=9).status_code == 409
    assert len(client.get("/api/v1/participants/P1/visits").json()["items"]) == 1


def test_a_day_that_got_its_visit_meanwhile_makes_no_second_one(client: TestClient, send: Any) -> None:
    (open_one,) = send(("b.zip", device_zip(("cdbs",), minute=NOON_NEXT_DAY))).json()["proposals"]
    assert client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2026-03-03"}).status_code == 201
    assert add(client, open_one).status_code == 409


@pytest.mark.parametrize(
    ("others", "number", "says"),
    [
        ({3: "2026-03-30"}, 2, "It gets number 2."),
        ({2: "2026-03-30", 3: "2026-04-27"}, 4, "It gets number 4, though visit 3 is of 2026-04-27: numbers in use are not changed."),
        ({2: None, 4: "2026-03-30"}, 3, "It gets number 3."),
        ({2: "2026-03-02"}, 3, "It gets number 3."),
    ],
)
def test_the_number_follows_the_dates_where_one_is_free_and_else_the_page_says_what_happens(
    client: TestClient, send: Any, others: dict[int, str | None], number: int, says: str
) -> None:
    for other, day in others.items():
        assert client.post("/api/v1/participants/P1/visits", json={"number": other, "date": day}).status_code == 201
    (open_one,) = send(("b.zip", device_zip(("cdbs",), minute=NOON_NEXT_DAY))).json()["proposals"]
    assert says in client.get("/participants/P1/proposals", headers={"Accept": "text/html"}).text
    made = add(client, open_one).json()["visit"]
    assert (made["number"], made["date"]) == (number, "2026-03-03")
