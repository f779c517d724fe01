"""Comparisons begin with the best of the ranking, whichever page leads to them."""

from __future__ import annotations

import re
from collections.abc import Callable
from html import unescape

from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from tests.app.evaluation.ranking.test_behaviours import apart
from tests.app.evaluations import judged
from tests.ml.ope.posterior.draws import N

Upload = Callable[..., int]
WORSE = {"outcome_draws": {"tremor_percent": [45.0] * N}}


def link(client: TestClient, page: str) -> str:
    """Find where a page leads for a comparison."""
    (found,) = re.findall(r'href="([^"]*/compare[^"]*)"', client.get(page).text)
    return unescape(found)


def compared(client: TestClient, path: str) -> tuple[int, list[str]]:
    """Return the session and the policies with which a comparison opens."""
    answer = client.get(path)
    assert answer.status_code == 200, answer.text
    named = [re.search(r'<option value="(\d+)" selected>([^<]*)<', select) for select in answer.text.split("<select")[1:]]
    chosen = [(found[1], found[2]) for found in named if found is not None and found[2] != "none"]
    assert "would have asked for" in answer.text, "and with what they would have asked for"
    return int(chosen[0][0]), [name for _, name in chosen[1:]]


def test_from_the_ranking_the_two_best_behaviours_stand_over_the_newest_session(
    client: TestClient, policies: list[int], judge: Callable[..., int], upload: Upload
) -> None:
    a, b, c = policies
    newest = upload("cdbs", lead=10)
    judge({a: judged(99.0, **WORSE), b: judged(50.0), c: judged(60.0)})
    assert compared(client, link(client, "/participants/P1/ranking")) == (newest, ["p2", "p1"]), "p0 is the first, and unsafe"
    judge({a: judged(70.0), b: judged(50.0), c: judged(60.0)}, coverage=apart(policies, 0.2, 0.01))
    assert compared(client, link(client, "/participants/P1/ranking"))[1] == ["p0", "p1"], "p2 does what p0 does"
    assert client.patch(f"/api/v1/policies/{b}", json={"retired_reason": "replaced"}).status_code == 200
    assert compared(client, link(client, "/participants/P1/ranking"))[1] == ["p0", "p2"], "nothing else is there"


def test_from_a_policy_it_stands_beside_the_best_other_behaviour(
    client: TestClient, policies: list[int], judge: Callable[..., int], upload: Upload
) -> None:
    a, b, c = policies
    newest = upload("cdbs", lead=10)
    page = "/participants/P1/policies/{}"
    assert compared(client, link(client, page.format(b))) == (newest, ["p1", "p0"]), "without a ranking the first other one"
    judge({a: judged(70.0), b: judged(50.0), c: judged(60.0)}, coverage=apart(policies, 0.2, 0.01))
    assert compared(client, link(client, page.format(b)))[1] == ["p1", "p0"]
    assert compared(client, link(client, page.format(a)))[1] == ["p0", "p1"], "p2 is better, and does what p0 does"
    assert compared(client, link(client, page.format(c)))[1] == ["p2", "p1"], "nor is what stands for it"
    assert client.patch(f"/api/v1/policies/{a}", json={"retired_reason": "replaced"}).status_code == 200
    assert compared(client, link(client, page.format(a)))[1] == ["p0", "p2"], "a retired one may be looked at, and is no choice"


def test_from_a_session_the_two_best_that_take_its_beta_stand_over_it(
    client: TestClient, policies: list[int], judge: Callable[..., int], upload: Upload
) -> None:
    a, b, c = policies
    session = upload("cdbs", lead=10)
    upload("random", lead=10)
    judge({a: judged(50.0), b: judged(60.0), c: judged(70.0)})
    assert compared(client, link(client, f"/sessions/{session}")) == (session, ["p2", "p1"])


def test_a_policy_of_another_beta_is_not_among_those_that_a_session_begins_with(
    client: TestClient, policies: list[int], judge: Callable[..., int], upload: Upload, db: Session
) -> None:
    a, b, c = policies
    session = upload("cdbs", lead=10)
    judge({a: judged(70.0), b: judged(60.0), c: judged(50.0)})
    db.execute(text("update policy set snapshot_id = (select max(id) from buffer_snapshot) where id = :c"), {"c": c})
    db.commit()
    change = {"settings": {"beta_source": "time_domain"}, "reason": "another source"}
    assert client.put("/api/v1/participants/P1/settings", json=change).status_code == 200
    assert compared(client, f"/participants/P1/compare?session={session}") == (session, ["p2"]), "the others take another beta now"


def test_without_a_session_the_newest_whose_beta_policies_take_is_shown(
    client: TestClient, policies: list[int], judge: Callable[..., int], upload: Upload
) -> None:
    a, b, c = policies
    fits = upload("cdbs", lead=10)
    upload("cdbs", lead=10, beta_unit="mV")
    judge({a: judged(70.0), b: judged(60.0), c: judged(50.0)})
    assert compared(client, "/participants/P1/compare") == (fits, ["p0", "p1"]), "the newest one is in another unit"
    assert compared(client, f"/participants/P1/compare?policy={c}") == (fits, ["p2"])
