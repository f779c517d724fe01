"""The ranking: order, references, staleness, actual results, CSV and page, from estimates with known values."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.estimates.service import store_evaluation
from app.learning.policies import constant_onnx
from app.learning.snapshots import take_snapshot
from app.platform.errors import Invalid
from app.study.repository import participant_by_code
from app.tables.evaluations import Evaluation
from app.tables.learning import Policy
from tests.app.evaluations import estimate

Upload = Callable[..., int]
RANKING = "/api/v1/participants/P1/ranking"


def ranked(client: TestClient) -> dict[str, Any]:
    answer = client.get(RANKING)
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def test_before_any_evaluation_the_ranking_says_what_to_do(client: TestClient, participant_code: str) -> None:
    answer = client.get(RANKING)
    assert answer.status_code == 404
    assert "pipeline" in answer.json()["hint"]
    page = client.get("/participants/P1/ranking")
    assert page.status_code == 200
    assert "Not enough data." in page.text
    assert "no confirmed session" in page.text


def test_candidates_are_ranked_by_value_and_unsupported_ones_come_last(
    client: TestClient, policies: list[int], evaluate: Callable[..., int]
) -> None:
    a, b, c = policies
    evaluate({a: estimate("dlsm", 50.0), b: estimate("dlsm", 99.0, supported=False), c: estimate("dlsm", 52.0)})
    body = ranked(client)
    assert [(p["policy_id"], p["rank"], p["supported"]) for p in body["policies"]] == [(c, 1, True), (a, 2, True), (b, 3, False)]
    best = body["policies"][0]
    assert best["estimates"]["dlsm"] == {
        "value": 52.0, "low": 51.0, "high": 53.0, "level": 0.9, "standard_error": pytest.approx(1 / 1.64), "step_return": -28.0,
        "end_reward": 80.0, "supported": True, "flags": [], "n": 100, "predicted": best["predicted"],
    }  # fmt: skip
    assert best["predicted"]["energy"] == 0.4
    assert (body["horizon_steps"], body["gamma"], body["default_method"], body["stale"]) == (60, 0.99, "dlsm", False)
    assert "60 % of steps" in body["policies"][2]["flags"][0]["text"]


def test_the_probability_of_being_best_counts_aligned_draws(client: TestClient, policies: list[int], evaluate: Callable[..., int]) -> None:
    a, b, _ = policies
    # a common shift makes the intervals wide, and yet b is better in three of four draws
    common = [0.0, 10.0, -10.0, 5.0]
    evaluate(
        {
            a: estimate("dlsm", 50.0, spread=15, draws=[50 + x for x in common]),
            b: estimate("dlsm", 51.0, spread=15, draws=[51 + common[0], 51 + common[1], 51 + common[2], 49 + common[3]]),
        }
    )
    assert {p["policy_id"]: p["probability_best"] for p in ranked(client)["policies"]} == {a: 0.25, b: 0.75}


def test_references_stand_beside_the_candidates_and_the_best_constant_is_named(
    client: TestClient, policies: list[int], evaluate: Callable[..., int]
) -> None:
    evaluate({policies[0]: estimate("dlsm", 50.0)}, {1.0: 45.0, 0.7: 55.0, 0.4: 40.0})
    body = ranked(client)
    assert [p["policy_id"] for p in body["policies"]] == [policies[0]]
    assert {p["reference"]: p["estimates"]["dlsm"]["value"] for p in body["references"]} == {
        "best_constant": 55.0,
        "cdbs": 45.0,
        "constant": 40.0,
    }
    assert all(p["rank"] is None for p in body["references"])


def test_a_method_that_failed_is_named_and_another_ranks(client: TestClient, policies: list[int], db: Session) -> None:
    participant = participant_by_code(db, "P1", SYSTEM)
    snapshot = take_snapshot(db, participant, SYSTEM)
    arguments: dict[str, Any] = {"job_id": None, "created_by": "test", "snapshot": snapshot, "horizon_steps": 60, "config": {}}
    linear = {"estimates": {str(policies[0]): estimate("linear", 3.0)}}
    store_evaluation(db, candidates=policies, results={"dlsm": {"failed": "too few sessions"}, "linear": linear}, **arguments)
    with pytest.raises(Invalid, match="too few sessions"):
        store_evaluation(db, candidates=policies, results={"dlsm": {"failed": "too few sessions"}}, **arguments)
    db.commit()
    body = ranked(client)
    assert (body["default_method"], body["failed_methods"]) == ("linear", {"dlsm": "too few sessions"})
    assert client.get(RANKING, params={"method": "dlsm"}).status_code == 422


def test_another_method_can_rank(client: TestClient, policies: list[int], evaluate: Callable[..., int]) -> None:
    a, b, _ = policies
    pdis = {"estimates": {str(a): estimate("pdis", 1.0), str(b): estimate("pdis", 2.0)}}
    evaluate({a: estimate("dlsm", 60.0), b: estimate("dlsm", 50.0)}, pdis=pdis)
    assert [p["policy_id"] for p in ranked(client)["policies"]] == [a, b]
    assert [p["policy_id"] for p in client.get(RANKING, params={"method": "pdis"}).json()["policies"]] == [b, a]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda c, u: u("random", visit=1), "1 session newer: visit 1"),
        (lambda c, u: c.put("/api/v1/sessions/1/qoc", json={"rating": 2}), "1 session with corrected outcomes"),
        (lambda c, u: c.patch("/api/v1/sessions/1", json={"excluded_reason": "tablet froze"}), "1 session newly left out"),
        (lambda c, u: c.put("/api/v1/participants/P1/settings", json={"settings": {"c1": 0.5}}), "settings version 2 is in force"),
        (lambda c, u: c.put("/api/v1/participants/P1/settings", json={"settings": {"xi_beta": None}}), "no beta threshold"),
        (
            lambda c, u: c.post(
                "/api/v1/participants/P1/policies", data={"name": "late"}, files={"file": ("l.onnx", constant_onnx(0.5, 10))}
            ),
            "1 policy not in it: late",
        ),
    ],
    ids=["new session", "corrected outcome", "excluded session", "new settings", "threshold gone", "new policy"],
)
def test_whatever_changes_since_makes_the_ranking_stale_and_is_named(
    client: TestClient,
    upload: Upload,
    policies: list[int],
    evaluate: Callable[..., int],
    change: Callable[[TestClient, Upload], Any],
    reason: str,
) -> None:
    evaluate({i: estimate("dlsm", 50.0) for i in policies})
    assert ranked(client)["stale_reasons"] == []
    change(client, upload)
    body = ranked(client)
    assert body["stale"] is True
    assert any(reason in r for r in body["stale_reasons"]), body["stale_reasons"]
    assert body["snapshot"]["settings_version"] == 1
    assert "This ranking is out of date" in client.get("/participants/P1/ranking").text


def test_the_newest_evaluation_is_the_ranking_and_older_ones_are_not_mixed_in(
    client: TestClient, upload: Upload, policies: list[int], evaluate: Callable[..., int]
) -> None:
    a, b, c = policies
    evaluate({a: estimate("dlsm", 50.0), b: estimate("dlsm", 60.0), c: estimate("dlsm", 70.0)})
    upload("random")
    second = evaluate({a: estimate("dlsm", 50.0), b: estimate("dlsm", 40.0)})
    body = ranked(client)
    assert body["evaluation_id"] == second
    assert [p["policy_id"] for p in body["policies"]] == [a, b]
    assert body["stale_reasons"] == ["1 policy not in it: p2"]


def test_where_a_policy_ran_its_actual_return_stands_beside_the_estimate(
    client: TestClient, upload: Upload, policies: list[int], evaluate: Callable[..., int]
) -> None:
    session = upload("rl", level=0.8, policy=policies[0], qoc={"grasp_hz": 2.0, "rating": 8, "tremor_percent": 20.0})
    evaluate({i: estimate("dlsm", 50.0) for i in policies}, {1.0: 45.0})
    tested = {p["policy_id"]: p["tested"] for p in ranked(client)["policies"]}
    assert [(p["tested"]["sessions"], p["tested"]["energy"]) for p in ranked(client)["references"]] == [(1, pytest.approx(1.0))]  # cDBS
    trace = client.get(f"/api/v1/sessions/{session}/trace").json()
    beta, cdbs = np.array(trace["beta"][10:]), client.get("/api/v1/sessions/3/trace").json()
    steps = (np.where(beta < 1.0, 0.0, -1.0) - 0.3 * 0.8) * 0.99 ** np.arange(60)
    assert tested[policies[0]] == {
        "sessions": 1,
        "sessions_with_return": 1,
        "mean_return": pytest.approx(steps.sum() + 10 * 2.0 + 10 * 8 - 10 * 0.2, abs=1e-5),
        "mean_step_return": pytest.approx(steps.sum(), abs=1e-5),
        "mean_end_reward": pytest.approx(98.0),
        "energy": pytest.approx(0.64, abs=1e-5),
        "mean_beta": pytest.approx(beta.mean(), abs=1e-5),
        "grasp_hz": 2.0,
        "rating": 8.0,
        "tremor_percent": 20.0,
        "stopped": 0,
        "energy_difference": pytest.approx(0.64 - 1, abs=1e-5),
        "mean_beta_difference": pytest.approx(beta.mean() - np.mean(cdbs["beta"][10:]), abs=1e-5),
        "grasp_hz_difference": 0.0,
        "rating_difference": 1.0,
        "tremor_percent_difference": 10.0,
        "visits": [
            {
                "visit": 1,
                "energy_difference": pytest.approx(0.64 - 1, abs=1e-5),
                "mean_beta_difference": pytest.approx(beta.mean() - np.mean(cdbs["beta"][10:]), abs=1e-5),
                "grasp_hz_difference": 0.0,
                "rating_difference": 1.0,
                "tremor_percent_difference": 10.0,
            }
        ],
    }
    strip = re.findall(r'<svg class="glyph".*?</svg>', client.get("/participants/P1/ranking").text, re.S)
    assert [s.count('r="3" fill="var(--c-surface)"') for s in strip[:4]] == [1, 1, 1, 1], "a ring for the visit that measured it"
    assert tested[policies[1]] is None


def test_one_job_has_one_evaluation(db: Session, client: TestClient, policies: list[int]) -> None:
    job = client.post("/api/v1/participants/P1/jobs", json={"kind": "evaluate"}).json()["id"]
    participant = participant_by_code(db, "P1", SYSTEM)
    snapshot = take_snapshot(db, participant, SYSTEM)
    for value in (50.0, 60.0):
        store_evaluation(
            db, job_id=job, created_by="test", snapshot=snapshot, horizon_steps=60, candidates=policies, config={},
            results={"dlsm": {"estimates": {str(policies[0]): estimate("dlsm", value)}}},
        )  # fmt: skip
    db.commit()
    assert db.scalar(select(func.count()).select_from(Evaluation)) == 1
    assert ranked(client)["policies"][0]["estimates"]["dlsm"]["value"] == 50.0


def test_the_csv_has_a_row_for_every_policy_and_method_and_no_formulas(
    client: TestClient, db: Session, policies: list[int], evaluate: Callable[..., int]
) -> None:
    db.get_one(Policy, policies[0]).name = "=cmd()"
    db.commit()
    evaluate(
        {policies[0]: estimate("dlsm", 50.0), policies[1]: estimate("dlsm", 51.0)},
        wis={"estimates": {str(policies[0]): estimate("wis", 9.0)}},
    )
    answer = client.get(RANKING, params={"format": "csv"})
    assert answer.headers["content-type"].startswith("text/csv")
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert [(r["policy_id"], r["method"], float(r["value"])) for r in rows] == [
        (str(policies[1]), "dlsm", 51.0),
        (str(policies[0]), "dlsm", 50.0),
        (str(policies[0]), "wis", 9.0),
    ]
    assert rows[1]["name"] == "'=cmd()"
    for column in (
        "low", "high", "standard_error", "n", "step_return", "end_reward", "energy", "mean_beta", "grasp_hz", "rating", "tremor_percent",
        "flags", "decision", "decision_reason", "gain_low", "probability_best", "retired", "beta_unit", "tested_sessions",
        "tested_mean_return", "tested_energy", "tested_rating",
    ):  # fmt: skip
        assert column in rows[0], column
    assert [r["supported"] for r in rows] == ["True"] * 3
    assert (rows[0]["decision"], rows[0]["tested_sessions"]) == ("cannot_tell", "0")
    assert client.get("/participants/P1/ranking.csv").text == answer.text


def test_the_page_shows_ranks_intervals_flags_and_sends_picks_to_the_plan(
    client: TestClient, policies: list[int], evaluate: Callable[..., int]
) -> None:
    evaluation = evaluate(
        {policies[0]: estimate("dlsm", 50.0), policies[1]: estimate("dlsm", 99.0, supported=False)}, {1.0: 45.0}
    )  # fmt: skip
    page = client.get("/participants/P1/ranking").text
    for text in (
        "cDBS (reference)",
        "not supported",
        "60 % of steps",
        'action="/participants/P1/plan/draft"',
        f'name="evaluation_id" value="{evaluation}"',
        f'name="policy_ids" value="{policies[0]}"',
        "Estimated return",
    ):
        assert text in page
    assert 'type="checkbox"' in page


def test_the_filter_keeps_ranks_and_says_how_many_it_leaves_out(
    client: TestClient, upload: Upload, policies: list[int], evaluate: Callable[..., int], db: Session
) -> None:
    a, b, c = policies
    upload("rl", level=0.8, policy=c)
    evaluate({a: estimate("dlsm", 50.0), b: estimate("dlsm", 99.0, supported=False), c: estimate("dlsm", 40.0)})

    def kept(**query: str) -> tuple[list[tuple[int, int]], int]:
        body = client.get(RANKING, params=query).json()
        return [(p["policy_id"], p["rank"]) for p in body["policies"]], body["hidden"]

    assert kept() == ([(a, 1), (c, 2), (b, 3)], 0)
    assert kept(supported="true") == ([(a, 1), (c, 2)], 1)
    assert kept(tested="yes") == ([(c, 2)], 2)
    assert kept(tested="no", supported="true") == ([(a, 1)], 2)
    assert kept(kind="external")[1] == 0
    assert kept(kind="trained") == ([], 3)
    assert client.get(RANKING, params={"kind": "magic"}).status_code == 422
    page = client.get("/participants/P1/ranking", params={"method": "dlsm", "supported": "", "kind": "", "tested": "yes"})
    assert page.status_code == 200
    assert "2 of 3 left out" in page.text
    assert '<details class="fold" open>' in page.text, "what was asked of the fold is not hidden in it"
    fold = page.text[page.text.index('class="fold"') : page.text.index("Single methods") if "Single methods" in page.text else None]
    candidates = fold[fold.index("Candidates by DLSM") : fold.index("caption>References")]
    assert f'/policies/{c}"' in candidates
    assert f'/policies/{a}"' not in candidates
    assert "No candidate passes this filter" in client.get("/participants/P1/ranking", params={"kind": "distilled"}).text
    assert client.get("/participants/P1/ranking", params={"tested": "perhaps"}).status_code == 422


def test_an_evaluation_without_a_posterior_proposes_nothing_and_says_so(
    client: TestClient, policies: list[int], evaluate: Callable[..., int]
) -> None:
    """Nothing can be decided without the chances of outcomes, but a certain loss is unsafe."""
    a, b, c = policies
    evaluate({a: estimate("dlsm", 60.0), b: estimate("dlsm", 30.0), c: estimate("dlsm", 70.0, supported=False)}, {1.0: 45.0})
    found = {p["policy_id"]: p for p in ranked(client)["policies"]}
    assert {i: p["decision"] for i, p in found.items()} == {a: "cannot_tell", b: "unsafe", c: "cannot_tell"}
    assert {i: p["rank"] for i, p in found.items()} == {a: 1, c: 2, b: 3}, "unsafe and unsupported come last"
    reach = 1.645 * 2**0.5 / 1.64  # two independent standard errors of 1 / 1.64
    assert found[a]["gain"] == {
        "value": 15.0,
        "low": pytest.approx(15 - reach, abs=1e-3),
        "high": pytest.approx(15 + reach, abs=1e-3),
        "level": 0.9,
    }
    assert [r["code"] for r in found[b]["decision_reasons"]] == ["all_below_zero", "no_posterior"]
    client.patch(f"/api/v1/policies/{a}", json={"retired_reason": "worn out"})
    assert (ranked(client)["policies"][0]["decision"], ranked(client)["policies"][0]["decision_reason"]) == (
        "cannot_tell",
        "retired: worn out",
    )
    page = client.get("/participants/P1/ranking").text
    assert "By prediction, no policy is worth a visit yet" in page
    assert "evaluate again" in page


@pytest.mark.parametrize(
    ("best", "second", "sentences"),
    [
        (
            (44.0, True), (40.0, True),
            ["The cDBS reference is estimated at 47.0, above every candidate (best: p0, 44.0): by this estimate no candidate improves on "
             "cDBS in return."],
        ),
        (
            (46.0, True), (40.0, True),
            ["The cDBS reference is estimated at 47.0, above every candidate (best: p0, 46.0): by this estimate no candidate improves on "
             "cDBS in return. The intervals overlap."],
        ),
        (
            (48.0, True), (40.0, True),
            ["The cDBS reference is estimated at 47.0, the best candidate, p0, at 48.0; the intervals overlap: whether it improves on cDBS "
             "in return is open."],
        ),
        ((60.0, True), (59.0, False), []),
        (
            (44.0, True), (99.0, False),
            ["The cDBS reference is estimated at 47.0, above every supported candidate (best: p0, 44.0): by this estimate no supported "
             "candidate improves on cDBS in return.",
             "Hardly any session came near what these do; value and place are guesses: p1 (99.0)."],
        ),
        (
            (44.0, False), (40.0, False),
            ["No candidate is supported by the data: these estimates cannot say whether one improves on cDBS."],
        ),
    ],
    ids=["below", "below and overlapping", "above and overlapping", "clearly above", "unsupported value above", "none supported"],
)  # fmt: skip
def test_notes_say_how_the_best_candidate_stands_to_cdbs(
    client: TestClient,
    policies: list[int],
    evaluate: Callable[..., int],
    best: tuple[float, bool],
    second: tuple[float, bool],
    sentences: list[str],
) -> None:
    a, b, _ = policies
    evaluate({a: estimate("dlsm", best[0], supported=best[1]), b: estimate("dlsm", second[0], supported=second[1])}, {1.0: 47.0})
    assert ranked(client)["notes"] == sentences
    page = client.get("/participants/P1/ranking").text
    assert all(sentence in page for sentence in sentences)


def test_without_end_of_session_rewards_the_predicted_outcomes_stand_beside_the_return(
    client: TestClient, policies: list[int], evaluate: Callable[..., int]
) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"c2": 0.0, "c3": 0.0, "c4": 0.0}})
    evaluate({policies[0]: estimate("dlsm", -30.0) | {"step_return": -30.0, "end_reward": 0.0}})
    shown = ranked(client)["policies"][0]
    assert (shown["estimates"]["dlsm"]["end_reward"], shown["predicted"]["rating"], shown["predicted"]["grasp_hz"]) == (0.0, 7.5, 2.1)
    page = client.get("/participants/P1/ranking").text
    fold = page[page.index("Candidates by DLSM") :]
    row = fold[fold.index(f'/policies/{policies[0]}"') :].split("</tr>")[0]
    cells = [cell.split("<")[0] for cell in row.split('<td class="num">')[1:]]
    for value in ("\N{MINUS SIGN}30.00", "0.00", "40", "0.9", "2.1", "7.5", "12"):
        assert any(cell.strip().startswith(value) for cell in cells), (value, cells)


def test_the_pages_csv_is_of_the_method_that_the_page_ranks_by(
    client: TestClient, policies: list[int], evaluate: Callable[..., int]
) -> None:
    a, b, c = policies
    other = {"estimates": {str(a): estimate("linear", 9.0), str(b): estimate("linear", 1.0), str(c): estimate("linear", 5.0)}}
    evaluate({a: estimate("dlsm", 1.0), b: estimate("dlsm", 3.0), c: estimate("dlsm", 2.0)}, linear=other)
    for method, best in (("dlsm", b), ("linear", a)):
        page = client.get("/participants/P1/ranking", params={"method": method}).text
        assert f"/participants/P1/ranking.csv?method={method}" in page
        rows = list(csv.DictReader(io.StringIO(client.get("/participants/P1/ranking.csv", params={"method": method}).text)))
        assert next(r for r in rows if r["rank"] == "1")["policy_id"] == str(best)
