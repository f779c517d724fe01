"""The page of one policy: verdict, picture, lineage, and learning behind a fold."""

from __future__ import annotations

from collections.abc import Callable

from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from tests.app.evaluation.ranking.test_picture import stored_map
from tests.app.evaluations import judged
from tests.app.words import above_fold, methods_named
from tests.ml.ope.posterior.draws import N


def test_it_shows_what_the_policy_does_and_where_it_comes_from(
    client: TestClient, policies: list[int], judge: Callable[..., int], db: Session
) -> None:
    a, b, c = policies
    worse = {"tremor_percent": [45.0] * N}
    judge({a: judged(50.0), b: judged(60.0, outcome_draws=worse)}, coverage=stored_map(b))
    db.execute(text("update policy set parent_id = :parent where id = :id"), [{"parent": b, "id": a}, {"parent": c, "id": b}])
    db.commit()
    page = client.get(f"/participants/P1/policies/{b}")
    words = above_fold(page.text)
    assert "is worse by more than twice its margin, most often tremor" in words
    assert "Amplitude (mA)" in words
    assert f'href="/participants/P1/compare?policy={b}&amp;policy={a}"' in page.text
    assert methods_named(words) == []
    child = above_fold(client.get(f"/participants/P1/policies/{a}").text)
    assert "Fine-tuned from p1 Fine-tuned from p2" in child, "the whole line, the nearest first"
    assert "in no ranking yet" in above_fold(client.get(f"/participants/P1/policies/{c}").text)


def test_the_ranking_keeps_to_its_contract_field_by_field(client: TestClient, policies: list[int], judge: Callable[..., int]) -> None:
    """Programs read these parts of a ranking: names, types, and the one entry for the posterior."""
    judge({policies[0]: judged(50.0), policies[1]: judged(60.0, outcome_draws={"tremor_percent": [45.0] * N})})
    body = client.get("/api/v1/participants/P1/ranking").json()
    assert (body["default_method"], body["choice"]) == ("posterior", None)
    assert "posterior" in body["methods"]
    for policy in body["policies"]:
        estimate = policy["estimates"]["posterior"]
        assert all(isinstance(estimate[name], float) for name in ("value", "low", "high", "level"))
        assert "gain" not in estimate
        assert {"value", "low", "high"} <= set(policy["gain"])
        assert estimate["value"] == {policies[0]: 50.0, policies[1]: 60.0}[policy["policy_id"]], "an absolute return"
        assert policy["decision"] in {"test", "test_with_care", "same_as_cdbs", "unsafe", "cannot_tell"}
        assert isinstance(policy["decision_reason"], str)
        assert policy["decision_reasons"]
        for reason in policy["decision_reasons"]:
            assert set(reason) == {"code", "value", "limit", "unit"}
            assert isinstance(reason["code"], str)
        for flag in policy["flags"] + estimate["flags"]:
            assert isinstance(flag, dict)
            assert {"code", "value", "limit", "unit"} <= set(flag)
    assert [(p["rank"], p["decision"]) for p in body["policies"]] == [(1, "test"), (2, "unsafe")]
