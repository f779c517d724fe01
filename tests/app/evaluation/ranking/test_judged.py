"""Consequences of an evaluation are computed once, and again as soon as anything that they depend on changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.ranking.service import current
from app.platform.kept import forget
from app.study.repository import participant_by_code
from tests.app.evaluations import judged

FALL = {"kind": "fall", "severity": "severe", "serious": True, "note": "broke a wrist"}
PAGES = (
    "/participants/P1/ranking",
    "/participants/P1/ranking?method=posterior&tested=no",
    "/participants/P1/policies/{0}",
    "/visits/1/plan",
)


def seen(client: TestClient, policies: list[int]) -> list[str]:
    """Read everything that shows what was estimated: the interface's ranking and the pages."""
    answers = [client.get("/api/v1/participants/P1/ranking")]
    answers += [client.get(path.format(*policies), headers={"accept": "text/html"}) for path in PAGES]
    assert [a.status_code for a in answers] == [200] * len(answers)
    return [a.text for a in answers]


def test_draws_are_read_once_and_the_ranking_is_the_same_before_and_after(
    client: TestClient, policies: list[int], judge: Callable[..., int], statements: list[str]
) -> None:
    judge({policies[0]: judged(60.0), policies[1]: judged(50.0)})
    forget()
    first = seen(client, policies)
    assert any("estimate.details" in s for s in statements), "what is not kept is read"
    statements.clear()
    assert seen(client, policies) == first
    assert not any("estimate.details" in s for s in statements), "no draw is read a second time"
    forget()
    assert seen(client, policies) == first


CHANGES: dict[str, Callable[[TestClient, int, Callable[..., int]], Any]] = {
    "retired": lambda c, policy, _: c.patch(f"/api/v1/policies/{policy}", json={"retired_reason": "the patient disliked it"}),
    "harmful": lambda c, policy, _: c.post("/api/v1/participants/P1/adverse-events", json=FALL | {"policy_id": policy}),
    "margins": lambda c, *_: c.put("/api/v1/participants/P1/margins", json={"margins": {"test_within": 0.9}, "reason": "surer"}),
    "settings": lambda c, *_: c.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 2.5}}),
    "QoC": lambda c, *_: c.put("/api/v1/sessions/3/qoc", json={"grasp_hz": 1.1, "rating": 3}),
    "session": lambda _, policy, upload: upload("rl", level=0.8, policy=policy),
}


@pytest.mark.parametrize("change", CHANGES)
def test_whatever_an_evaluation_is_judged_by_makes_new_figures(
    client: TestClient, upload: Callable[..., int], policies: list[int], judge: Callable[..., int], change: str
) -> None:
    judge({policies[0]: judged(60.0), policies[1]: judged(50.0)})
    before = seen(client, policies)
    answer = CHANGES[change](client, policies[0], upload)
    assert isinstance(answer, int) or answer.status_code < 300, answer.text
    after = seen(client, policies)
    assert after[0] != before[0]
    assert after[1] != before[1]
    forget()
    assert seen(client, policies) == after, "what is shown is what is computed anew"


def test_to_ask_what_is_kept_for_its_draws_is_an_error(db: Session, policies: list[int], judge: Callable[..., int]) -> None:
    judge({policies[0]: judged(60.0)})
    found = current(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    own = found.assessment.candidates[0].posterior
    assert own is not None
    assert own.details["behaviour"]
    for ask in (own.details.get, own.details.__getitem__):
        with pytest.raises(RuntimeError, match="use the assessment with draws"):
            ask("draws")
