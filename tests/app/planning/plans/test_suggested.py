"""Suggestions on the plan's page: the portfolio of candidates that may be proposed, one sentence each; nothing unsafe or undecidable."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, update
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.ranking.service import current
from app.planning.plans.suggested import suggested as suggested_of
from app.study.repository import participant_by_code
from app.tables.learning import BufferSnapshot, Policy
from ml.ope.posterior.portfolio import portfolio
from tests.app.evaluations import judge as judge
from tests.app.evaluations import judged
from tests.app.evaluations import policies as policies
from tests.ml.ope.posterior.draws import N, cdbs

Judge = Callable[..., int]
UNSAFE = {"behaviour": {"below_cdbs_20_percent": 0.42}}
CAREFUL: dict[str, Any] = {"supported": False, "support": {"lowest_supported": 0.5, "dose": 0.4}}


def drawn(value: float, spread: float, first_half: int) -> list[float]:
    """Build draws: half of them `value` + `spread`, half less; opposite halves are opposite chances."""
    return [value + first_half * (spread if k < N / 2 else -spread) for k in range(N)]


@pytest.fixture
def suggested(client: TestClient, policies: list[int]) -> Callable[[], list[str]]:
    """The suggestions on the page of an open visit, as text."""
    visit = client.post("/api/v1/participants/P1/visits", json={"number": 2}).json()["id"]

    def read() -> list[str]:
        page = client.get(f"/visits/{visit}/plan", headers={"accept": "text/html"})
        assert page.status_code == 200
        found = re.search(r"<ol id=\"suggested\">(.*?)</ol>", page.text, re.S)
        items = re.findall(r"<li>(.*?)</li>", found.group(1), re.S) if found else []
        return [html.unescape(re.sub(r"<[^>]+>", "", item)) for item in items]

    return read


def test_the_best_comes_first_and_then_what_may_turn_out_better(
    policies: list[int], judge: Judge, suggested: Callable[[], list[str]]
) -> None:
    a, b, c = policies
    first, twin, other = drawn(10.0, 4.0, 1), drawn(9.9, 4.0, 1), drawn(8.0, 4.0, -1)
    judge({a: _with(10.0, first), b: _with(9.9, twin), c: _with(8.0, other)})
    found = suggested()
    assert [item.split(":")[0] for item in found] == ["p0", "p2"]
    assert found[0].startswith("p0: > 99 % likely to turn out better on the whole than cDBS; its test alone would settle")
    assert found[1].startswith("p2: 50 % likely to turn out better on the whole than all above")


def test_the_noise_of_a_test_is_that_of_as_many_cdbs_sessions_as_the_day_has(
    client: TestClient, db: Session, policies: list[int], judge: Judge
) -> None:
    """One policy or two are compared with one cDBS session, three against two; where fewer are worth a test the day has fewer slots."""
    reference = cdbs().to_json()
    reference["details"]["return_noise"] = 6.0
    random = np.random.default_rng(3)
    draws = {i: [reference["details"]["draws"][k] + float(x) for k, x in enumerate(random.normal(1.0, 9.0, N))] for i in policies}
    judge({i: _with(51.0, drawn) for i, drawn in draws.items()}, reference)
    found = current(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    gaps = {str(i): np.array(drawn) - np.array(reference["details"]["draws"]) for i, drawn in draws.items()}
    for slots, number, controls in ((1, 1, 1), (2, 2, 1), (3, 3, 2), (4, 3, 2)):
        assert [s.why for s in suggested_of(found, slots)] == list(portfolio(gaps, number, noise=6.0 * (1 + 1 / controls) ** 0.5))


def test_unsafe_policies_are_not_suggested_and_one_with_care_at_most_also_without_an_order(
    policies: list[int], judge: Judge, suggested: Callable[[], list[str]]
) -> None:
    a, b, c = policies
    judge({a: judged(90.0, **UNSAFE), b: judged(60.0, **CAREFUL), c: _with(59.0, drawn(59.0, 10.0, 1), **CAREFUL)})
    assert [item.split(":")[0] for item in suggested()] in (["p1"], ["p2"])
    judge({a: judged(90.0, told=False, **UNSAFE), b: judged(60.0, told=False), c: judged(50.0, told=False, **UNSAFE)})
    assert [item.split(":")[0] for item in suggested()] == ["p1"], "that the data cannot order policies hides no verdict"


def _with(value: float, draws: list[float], **changed: Any) -> dict[str, Any]:
    estimate = judged(value, **changed)
    estimate["details"]["draws"] = draws
    return estimate


def test_slots_that_no_policy_takes_name_sessions_that_would_tell_and_ask_for_none(
    client: TestClient, policies: list[int], judge: Judge, suggested: Callable[[], list[str]]
) -> None:
    a, b, c = policies
    noise = {"coverage": {"policies": {}, "session_noise": {"tremor_percent": 3.0}}}
    undecided = {"tremor_percent": [10.0 + 0.03 * k for k in range(N)]}
    likelier = {"tremor_percent": [9.9 + 0.03 * k for k in range(N)]}
    judge(
        {
            a: judged(50.0, outcome_draws=undecided, support={"dose": 0.6}),
            b: judged(50.0, outcome_draws=likelier, support={"dose": 0.62}),
            c: judged(50.0, **UNSAFE),
        },
        **noise,
    )
    assert suggested() == []
    page = client.get("/visits/2/plan", headers={"accept": "text/html"}).text
    fields = re.search(r'<fieldset id="held">(.*?)</fieldset>', page, re.S)
    assert fields is not None
    words = html.unescape(" ".join(re.sub(r"<[^>]+>", " ", fields.group(1)).split()))
    assert re.search(r"sessions near mA \d sessions? held near it would tell whether 'p1' and 'p0' are worth a test", words), words
    assert re.findall(r'name="held_amplitude"[^>]* value="([^"]*)"', fields.group(1)) == ["1.9", ""]
    assert re.findall(r'name="held_sessions"[^>]* value="([^"]*)"', fields.group(1)) == ["", ""], "the clinician decides"
    asked = {"held_unit": ["amplitude_ma"] * 2, "held_amplitude": ["1.9", ""], "held_sessions": ["2", ""]}
    assert client.post("/visits/2/plan", data=asked, follow_redirects=False).status_code == 303
    held = [s["design"]["level"] for s in client.get("/api/v1/visits/2/plan").json()["sessions"] if s["design"]]
    assert held == pytest.approx([1.9 / 3, 1.9 / 3])
    judge({i: judged(50.0, told=False, outcome_draws=undecided) for i in policies}, cdbs(told=False).to_json(), **noise)
    page = client.get("/visits/2/plan", headers={"accept": "text/html"}).text
    assert re.findall(r'name="held_amplitude"[^>]* value="([^"]*)"', page) == [f"{0.65 * 3:.1f}", ""]
    assert "no number of sessions is known to settle it" in page
    assert "would tell" not in page


def test_policies_that_do_the_same_stand_under_their_teacher_and_can_still_be_ticked(
    client: TestClient, db: Session, policies: list[int], judge: Judge
) -> None:
    a, b, c = policies
    judge({a: judged(50.0), b: judged(50.0), c: judged(60.0, behaviour={"mean_amplitude": 0.3})})
    snapshot = db.scalars(select(BufferSnapshot.id)).one()
    for student in (b, c):  # what c does differs from what its teacher does
        db.execute(update(Policy).where(Policy.id == student).values(kind="distilled", teacher_id=a, snapshot_id=snapshot))
    db.commit()
    visit = client.post("/api/v1/participants/P1/visits", json={"number": 2}).json()["id"]
    page = client.get(f"/visits/{visit}/plan", headers={"accept": "text/html"}).text
    assert page.count('name="policy_ids"') == 3
    (fold,) = re.findall(r"<details class=\"counted\"><summary><small>and 1 that does the same</small>(.*?)</details>", page, re.S)
    assert re.findall(r'aria-label="Test (p\d)"', fold) == ["p1"]
    assert client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": [b]}).status_code == 201
    again = client.get(f"/visits/{visit}/plan", headers={"accept": "text/html"}).text
    assert '<details class="counted" open><summary><small>and 1 that does the same' in again, "what the draft holds is not hidden"


def test_one_button_drafts_the_suggested_visit_and_names_its_minutes(client: TestClient, policies: list[int], judge: Judge) -> None:
    a, b, _ = policies
    judge({a: _with(10.0, drawn(10.0, 4.0, 1)), b: _with(8.0, drawn(8.0, 4.0, -1))})
    visit = client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2046-04-06"}).json()["id"]
    for path in ("/participants/P1", "/participants/P1/ranking"):
        page = client.get(path, headers={"accept": "text/html"}).text
        (form,) = re.findall(r'<form method="post" action="([^"]+)"[^>]*id="suggested-visit"(.*?)</form>', page, re.S)
        words = " ".join(re.sub(r"<[^>]+>", " ", form[1]).split())
        assert "Suggested visit 2, 2046-04-06: 40 minutes, 3 sessions (p0, p1, and cDBS in between), washouts included." in words, path
        assert "One policy alone takes 25 minutes" in words
    fields: dict[str, list[str]] = {}
    for name, value in re.findall(r'name="(\w+)" value="([^"]*)"', form[1]):
        fields.setdefault(name, []).append(value)
    drafted = client.post(form[0], data=fields, follow_redirects=False)
    assert drafted.headers["location"] == f"/visits/{visit}/plan?done=drafted", drafted.text
    plan = client.get(f"/api/v1/visits/{visit}/plan").json()
    assert sorted(s["policy_id"] for s in plan["sessions"] if s["policy_id"]) == [a, b]
    assert len(plan["sessions"]) == 3
    assert "suggested-visit" not in client.get("/participants/P1/ranking", headers={"accept": "text/html"}).text, "it has its plan"


def test_the_suggested_visit_is_offered_to_those_alone_who_draft(
    client: TestClient, client_as: Callable[[str], TestClient], policies: list[int], judge: Judge
) -> None:
    judge({policies[0]: judged(50.0)})
    for role, shown in (("coordinator", False), ("monitor", False), ("engineer", True), ("clinician", True)):
        page = client_as(role).get("/participants/P1/ranking", headers={"accept": "text/html"}).text
        assert ("Draft the suggested visit" in page) == shown, role
