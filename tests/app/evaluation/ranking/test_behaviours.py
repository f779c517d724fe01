"""One row of the ranking is one behaviour: policies with the same amplitudes are together, whatever each was trained from."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.ranking.answer import behaviours
from app.evaluation.ranking.service import current
from app.study.repository import participant_by_code
from tests.app.evaluation.ranking.test_picture import stored_map
from tests.app.evaluations import judged
from tests.app.words import above_fold
from tests.ml.ope.posterior.draws import N

PAGE = "/participants/P1/ranking"
Judge = Callable[..., int]
WORSE = {"outcome_draws": {"tremor_percent": [45.0] * N}}


def apart(policies: list[int], ab: float, ac: float = 0.3, bc: float = 0.3) -> dict[str, Any]:
    """Build what an evaluation stores of three policies that are so far apart."""
    a, b, c = map(str, policies)
    found = stored_map(policies[0])
    return {"policies": {}, "map": {**found["map"], "apart": {a: {b: ab, c: ac}, b: {c: bc}}}}  # type: ignore[dict-item]


def rows(client: TestClient) -> dict[str, list[str]]:
    """List names of the table's rows, each with those listed as doing the same."""
    page = client.get(PAGE).text
    body = re.search(r'id="candidates".*?</table>', page, re.S)
    assert body is not None
    found = {}
    for row in re.findall(r"<tr(?! class=.group).*?</tr>", body[0], re.S)[1:]:
        first, _, same = row.partition("nearly identical:")
        names = [re.findall(r">(p\d)</a>", part) for part in (first, same.partition("</td>")[0])]
        found[names[0][0]] = names[1]
    return found


def groups(db: Session) -> list[list[str]]:
    db.rollback()
    found = current(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    return [[a.policy.name for a in group] for group in behaviours(found.with_draws)]


def test_two_policies_that_nothing_binds_share_a_row_where_they_ask_for_the_same(
    client: TestClient, policies: list[int], judge: Judge
) -> None:
    a, b, c = policies
    judge({a: judged(50.0), b: judged(60.0), c: judged(40.0)}, coverage=apart(policies, 0.05))
    assert rows(client) == {"p1": ["p0"], "p2": []}, "the better one stands for both"
    words = above_fold(client.get(PAGE).text)
    assert "p1 external nearly identical: p0 test" in words
    assert words.count("p0 : energy") == 0, "what to test names each behaviour once"
    judge({a: judged(50.0), b: judged(60.0), c: judged(40.0)}, coverage=apart(policies, 0.051))
    assert rows(client) == {"p1": [], "p0": [], "p2": []}


def test_another_verdict_or_more_time_nearly_off_is_another_row(policies: list[int], judge: Judge, db: Session) -> None:
    a, b, c = policies
    judge({a: judged(50.0), b: judged(60.0, **WORSE), c: judged(40.0)}, coverage=apart(policies, 0.01, 0.01, 0.01))
    assert groups(db) == [["p0", "p2"], ["p1"]], "what is unsafe is never hidden under what is not"
    off = {"behaviour": {"below_cdbs_20_percent": 0.03}}
    judge({a: judged(50.0), b: judged(60.0, **off), c: judged(40.0)}, coverage=apart(policies, 0.01, 0.01, 0.01))
    assert groups(db) == [["p1"], ["p0", "p2"]]
    off = {"behaviour": {"below_cdbs_20_percent": 0.3}}
    judge({a: judged(50.0, **off), b: judged(60.0, **WORSE, **off), c: judged(40.0)}, coverage=apart(policies, 0.01, 0.01, 0.01))
    assert groups(db) == [["p2"], ["p1"], ["p0"]], "both are unsafe, for different reasons"


def test_everyone_in_a_row_does_the_same_as_the_one_who_stands_for_it(policies: list[int], judge: Judge, db: Session) -> None:
    a, b, c = policies
    judge({a: judged(60.0), b: judged(50.0), c: judged(40.0)}, coverage=apart(policies, 0.04, 0.08, 0.04))
    assert groups(db) == [["p0", "p1"], ["p2"]], "p2 is near p1 alone, and p0 stands for p1"


def test_one_that_was_tested_stands_for_those_that_were_not(
    client: TestClient, policies: list[int], judge: Judge, upload: Callable[..., int]
) -> None:
    a, b, c = policies
    upload("rl", level=0.4, policy=a)
    judge({a: judged(50.0), b: judged(60.0), c: judged(70.0)}, coverage=apart(policies, 0.01))
    assert rows(client) == {"p2": [], "p0": ["p1"]}
    assert re.search(
        r"p0 external nearly identical: p1 [a-z ]+1.2 mA[a-z ]*: 0.9 mA to 1.5 mA test .*? 1 session ", above_fold(client.get(PAGE).text)
    )
    upload("rl", level=0.6, policy=b)
    assert "p1 external nearly identical: p0 (tested)" in above_fold(client.get(PAGE).text), "the best of those that were tested"


def test_each_keeps_its_own_numbers_where_it_is_planned_or_looked_at(client: TestClient, policies: list[int], judge: Judge) -> None:
    a, b, _ = policies
    posterior = {
        a: judged(60.0, supported=False, support={"lowest_supported": 0.5}),
        b: judged(50.0, supported=False, support={"lowest_supported": 0.6}),
    }
    judge(posterior, coverage=apart(policies, 0.01))
    assert rows(client) == {"p0": ["p1"]}
    words = above_fold(client.get(f"/participants/P1/policies/{b}").text)
    assert "not below 1.8 mA" in words, "0.6 of 3 mA, not 0.5"
    assert "Expected against cDBS: energy \N{MINUS SIGN}40 %, grasp unchanged" in words
    assert "In one row of the ranking with p0 : it asks for the same, within 5 % of the cDBS amplitude on average." in words
    visit = client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2046-04-06"}).json()["id"]
    plan = client.get(f"/visits/{visit}/plan").text
    assert {i: re.search(rf'name="limit_{i}"[^>]*value="([0-9.]+)"', plan)[1] for i in (a, b)} == {a: "0.5000", b: "0.6000"}  # type: ignore[index]
    assert "and 1 that does the same" in plan


def test_without_distances_only_a_student_is_said_to_do_what_its_teacher_does(policies: list[int], judge: Judge, db: Session) -> None:
    a, b, c = policies
    judge({a: judged(50.0), b: judged(60.0), c: judged(40.0)}, coverage=stored_map(a))
    db.execute(text("update policy set snapshot_id = (select max(id) from buffer_snapshot), kind = 'trained' where id = :a"), {"a": a})
    db.execute(
        text("update policy set snapshot_id = (select max(id) from buffer_snapshot), kind = 'distilled', teacher_id = :a where id = :b"),
        {"a": a, "b": b},
    )
    db.commit()
    assert groups(db) == [["p0", "p1"], ["p2"]], "a teacher stands for its better student"
