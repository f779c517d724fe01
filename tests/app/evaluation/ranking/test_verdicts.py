"""Verdicts in the ranking: from the posterior, by the participant's margins, with rank and reasons; and what the page says first."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from html import unescape
from typing import Any

from fastapi.testclient import TestClient
from pypdf import PdfReader
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.evaluation.ranking.decisions import Circumstances, decide
from app.learning.policies import constant_onnx
from app.tables.learning import Policy
from app.tables.participants import MarginsVersion
from ml.designs import Bound
from ml.ope.flags import Flag
from ml.ope.posterior import verdict
from ml.ope.posterior.further_sessions import Place
from ml.ope.support.behaviour_map import COLUMNS, BehaviourMap, Curve
from tests.app.evaluation.ranking.test_picture import stored_map
from tests.app.evaluations import judged
from tests.app.words import above_fold, flat, methods_named
from tests.conftest import PASSWORD
from tests.ml.ope.posterior.draws import N, cdbs, share

RANKING = "/api/v1/participants/P1/ranking"
PAGE = "/participants/P1/ranking"
WORSE = {"outcome_draws": {"tremor_percent": [45.0] * N}}
NEARLY_OFF = {"behaviour": {"below_cdbs_20_percent": 0.42}}
Judge = Callable[..., int]


def few_near(sessions: int) -> dict[str, Any]:
    """Build the finding that too few sessions are near, as it is stored."""
    return Flag.of("few_near_sessions", float(sessions), 2.0, "sessions", refuses=True, dose=0.6).to_json()


def ranked(client: TestClient) -> dict[str, Any]:
    answer = client.get(RANKING)
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def first_screen(client: TestClient) -> str:
    """Return the page's words above the fold."""
    page = client.get(PAGE)
    assert page.status_code == 200
    return above_fold(page.text)


def test_the_posterior_ranks_and_its_verdicts_stand_in_the_contract(client: TestClient, policies: list[int], judge: Judge) -> None:
    a, b, c = policies
    judge({a: judged(50.0), b: judged(60.0, **WORSE), c: judged(70.0, supported=False)})
    body = ranked(client)
    assert (body["default_method"], body["methods"], body["choice"]) == ("posterior", ["posterior"], None)
    # b is worth more by its return and c most of all; unsafe ones come last, those at amplitudes hardly tried before them
    assert [(p["policy_id"], p["rank"], p["decision"]) for p in body["policies"]] == [
        (a, 1, "test"), (c, 2, "test_with_care"), (b, 3, "unsafe")
    ]  # fmt: skip
    assert set(body["policies"][0]["estimates"]["posterior"]) >= {"value", "low", "high", "level"}
    assert body["policies"][0]["decision_reasons"] == [
        {"code": "within_margins", "value": 1.0, "limit": 0.8, "unit": "probability"},
        {"code": "saves_energy", "value": 1.0, "limit": 0.9, "unit": "probability"},
    ]
    assert body["policies"][0]["gain"]["value"] == 50.0
    assert "likely within the margins of grasp, rating and tremor" in body["policies"][0]["decision_reason"]


def table_rows(page: str) -> tuple[list[str], list[str]]:
    """Return the names of the groups and the rows of the table of candidates."""
    found = re.findall(r"<tr.*?</tr>", page.split('id="candidates"')[1].split("</table>")[0], re.S)[1:]
    heads = [unescape(re.sub("<.*?>", "", row, flags=re.S)).strip() for row in found if 'class="group"' in row]
    return heads, [row for row in found if 'class="group"' not in row]


def test_the_page_groups_by_verdict_and_each_policy_keeps_the_rank_of_its_value(
    client: TestClient, policies: list[int], judge: Judge
) -> None:
    """A likely worse policy keeps the rank of its value after what is proposed; only a hazard is a place of its own."""
    a, b, c = policies
    likely_worse = {"outcome_draws": {"tremor_percent": [33.0] * N}}
    judge({a: judged(50.0), b: judged(60.0, **likely_worse), c: judged(70.0, **WORSE)})
    found = ranked(client)["policies"]
    assert [(p["policy_id"], p["rank"], p["decision"]) for p in found] == [(b, 1, "likely_worse"), (a, 2, "test"), (c, 3, "unsafe")]
    assert {p["policy_id"]: p["probability_best"] for p in found} == {a: 1.0, b: 0.0, c: 0.0}
    page = client.get(PAGE).text
    heads, rows = table_rows(page)
    assert heads == ["Suggested tests", "Not advised: planned only with a clinician's stated reason"]
    assert [re.findall(r">(p\d)</a>", r)[0] for r in rows] == ["p0", "p1", "p2"]
    assert [re.findall(r'<td class="num">(\d|—)</td>', r)[0] for r in rows] == ["2", "1", "3"]
    assert ['type="checkbox"' in r for r in rows] == [True, False, False]
    words = first_screen(client)
    assert words.index("Suggested tests") < words.index("p0 :") < words.index("p1 :"), "what is likely worse is no proposal"
    assert "p1 :" in words.split("Not advised:")[1]


def test_a_value_that_few_sessions_came_near_is_a_place(client: TestClient, policies: list[int], judge: Judge) -> None:
    a, b, c = policies
    few = Flag.of("few_near_sessions", 0.0, 2.0, "sessions", refuses=True).to_json()
    judge({a: judged(50.0), b: judged(60.0, supported=False) | {"flags": [few]}, c: judged(70.0, supported=False)})
    assert [p["policy_id"] for p in ranked(client)["policies"]] == [b, a, c], "amplitudes that were hardly tried come after what was"


def test_each_policy_says_how_far_it_follows_beta_and_what_that_adds(
    client: TestClient, policies: list[int], judge: Judge, db: Session
) -> None:
    a, b, _ = policies
    middle = tuple(0.5 + 0.02 * k for k in range(COLUMNS))
    curves = {str(a): Curve(middle, middle, middle), str(b): Curve((0.8,) * COLUMNS, (0.78,) * COLUMNS, (0.82,) * COLUMNS)}
    coverage = stored_map(a)
    coverage["map"] = replace(BehaviourMap.from_json(coverage["map"]), policies=curves).to_json()  # type: ignore[arg-type]
    judge({a: judged(50.0), b: judged(49.0)}, coverage=coverage)
    words = first_screen(client)
    assert "never run so far. Dose: adapts to beta around 2.19 mA: 1.56 mA to 2.82 mA." in words, (
        "what it adds is not known without constants"
    )
    held = {float(p.config["amplitude"]): p.id for p in db.scalars(select(Policy).where(Policy.algorithm == "constant"))}
    levels = sorted(level for level in held if level < 1.0)
    posterior = {held[level]: judged(45.0) for level in levels}
    judge({a: judged(50.0), b: judged(45.5)} | posterior, cdbs(value=45.0).to_json(), coverage=coverage, candidates=[a, b])
    adds = f"adapting to beta adds +5.0 points of the return (+5.0 to +5.0) to {3 * 0.6**0.5:.2f} mA all the time"
    assert f"adapts to beta around 2.19 mA: 1.56 mA to 2.82 mA; {adds}" in first_screen(client), "its energy is 0.6 of that of cDBS"
    page = flat(client.get(f"/participants/P1/policies/{b}").text)
    assert "same as 2.4 mA all the time: 2.34 mA to 2.46 mA; adapting to beta adds +0.5 points" in page


def test_a_change_of_margins_changes_the_verdict_at_once(client: TestClient, policies: list[int], judge: Judge) -> None:
    judge({policies[0]: judged(50.0, outcome_draws={"tremor_percent": [26.0] * N})})
    before = ranked(client)
    assert before["policies"][0]["decision"] == "test"
    change = {"margins": {"tremor_points": 5}, "reason": "she fears tremor most"}
    assert client.put("/api/v1/participants/P1/margins", json=change).status_code == 200
    body = ranked(client)
    assert body["policies"][0]["decision"] == "likely_worse"
    assert body["stale_reasons"] == before["stale_reasons"], "margins are asked of the stored posterior: nothing has to be evaluated again"


def test_locked_margins_hold_in_the_ranking_too_and_newer_levels_count_at_once(
    client: TestClient, policies: list[int], judge: Judge
) -> None:
    judge({policies[0]: judged(50.0, outcome_draws={"tremor_percent": [26.0] * N})})
    margins = "/api/v1/participants/P1/margins"
    assert client.post(f"{margins}/locks", json={"version": 1, "reason": "protocol", "password": PASSWORD}).status_code == 201
    assert client.put(margins, json={"margins": {"tremor_points": 5}, "reason": "she fears tremor most"}).status_code == 200
    assert ranked(client)["policies"][0]["decision"] == "test", "the analyses go by the locked margins as well"
    page = client.get("/participants/P1/ranking", headers={"Accept": "text/html"}).text
    assert "tremor at most 10 percentage points more" in page
    assert client.put(margins, json={"margins": {"test_saves": 0.95}, "reason": "longer battery"}).status_code == 200
    assert "at least 95 % likely to use less energy" in client.get("/participants/P1/ranking", headers={"Accept": "text/html"}).text
    assert client.post(f"{margins}/locks", json={"version": 3, "reason": "amended", "password": PASSWORD}).status_code == 201
    assert ranked(client)["policies"][0]["decision"] == "likely_worse"


def test_without_ordering_skill_there_are_no_ranks_and_verdicts_stay(client: TestClient, policies: list[int], judge: Judge) -> None:
    a, b, c = policies
    judge({a: judged(50.0, told=False), b: judged(99.0, told=False), c: judged(70.0, told=False, **NEARLY_OFF)}, cdbs(told=False).to_json())
    body = ranked(client)
    assert {(p["rank"], p["probability_best"]) for p in body["policies"]} == {(None, None)}
    assert [(p["name"], p["decision"]) for p in body["policies"]] == [("p0", "test"), ("p1", "test"), ("p2", "unsafe")], "by name"
    assert "the data cannot order policies" in body["policies"][0]["decision_reason"]
    words = first_screen(client)
    assert "; by name, as the recordings cannot order them): p0 :" in words
    assert "the recordings so far cannot tell policies apart" in words
    assert "Not advised: p2 : unsafe, nearly off 42 % of the time" in words
    assert "#" not in words.split("Candidates compared with cDBS")[1].split("Policy")[0]


def test_the_page_says_how_often_its_chances_were_true(client: TestClient, policies: list[int], judge: Judge) -> None:
    judge({policies[0]: judged(50.0)})
    words = flat(client.get(PAGE).text)
    said = re.search(r"of policies called (\d+) % likely no worse, (\d+) % were((?:; of \d+ %, \d+ %)+)\.", words)
    assert said is not None
    assert words.count("on 60 virtual patients") == 1
    assert [*map(int, re.findall(r"\d+", said[0]))] == [round(100 * share) for _, *pair in verdict.RELIABILITY for share in pair]


def test_the_first_screen_says_what_to_test_why_and_at_what_risk_without_a_word_of_methods(
    client: TestClient, policies: list[int], judge: Judge
) -> None:
    a, b, c = policies
    likely = {"energy": [0.71] * N, "grasp_hz": [1.8] * 400 + [1.85] * 600, "tremor_percent": share(0.15, 21.0, 40.0)}
    judge({a: judged(50.0, outcome_draws=likely), b: judged(60.0, **NEARLY_OFF), c: judged(70.0, supported=False)})
    words = first_screen(client)
    assert (
        "Suggested tests (expected change from cDBS): p0 : energy \N{MINUS SIGN}29 %, grasp \N{MINUS SIGN}0.2 Hz, rating unchanged, "
        "tremor +4 "
        "percentage points; "
        "85 % chance that grasp, rating and tremor all stay within the margins; never run so far." in words
    )
    assert "Suggested tests with care, one of them at a visit (expected change from cDBS): p2 , not below 1.5 mA" in words
    assert "Not advised: p1 : unsafe, nearly off 42 % of the time" in words
    assert methods_named(words) == []


def test_the_participants_page_begins_with_the_words_of_the_ranking(client: TestClient, policies: list[int], judge: Judge) -> None:
    a, b, c = policies
    judge({a: judged(50.0), b: judged(60.0, **NEARLY_OFF), c: judged(70.0, supported=False)})
    ranking, words = first_screen(client), above_fold(client.get("/participants/P1").text)
    answered = ranking[ranking.index("Suggested tests") : ranking.index(" A proposal by stated rules")]
    assert words.index(answered) < words.index("Needs attention"), "the answer comes first"
    assert "out of date" not in words
    assert methods_named(words) == []
    client.post("/api/v1/participants/P1/policies", data={"name": "p3"}, files={"file": ("p3.onnx", constant_onnx(0.3, 10))})
    assert "out of date The study has changed since: what has ." in above_fold(client.get("/participants/P1").text)


def test_a_plan_says_of_its_policies_what_the_ranking_says(client: TestClient, policies: list[int], judge: Judge) -> None:
    likely = {"energy": [0.71] * N, "grasp_hz": [1.8] * 400 + [1.85] * 600, "tremor_percent": share(0.15, 21.0, 40.0)}
    judge({policies[0]: judged(50.0, outcome_draws=likely), policies[1]: judged(60.0, **NEARLY_OFF)})
    visit = client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2046-04-06"}).json()["id"]
    assert client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": [policies[0]], "seed": 1}).status_code == 201
    words = above_fold(client.get(f"/visits/{visit}/plan").text)
    assert re.search(r"RL p0 test 10 — 0 to 3 [0-9.]+ mA/s 85 % \N{MINUS SIGN}29 \N{MINUS SIGN}0.2 0.0 \+4 ", words), (
        "as the ranking's table"
    )
    assert methods_named(words) == []
    pages = PdfReader(io.BytesIO(client.get(f"/api/v1/visits/{visit}/plan.pdf").content)).pages
    sheet = " ".join(" ".join(page.extract_text() for page in pages).split())
    assert "Verdict test; 85 % chance that grasp, rating and tremor all stay within the margins" in sheet
    assert re.search(r"Against cDBS energy .29 %, grasp .0.2 Hz, rating unchanged, tremor \+4 percentage points", sheet)


def test_only_what_may_be_planned_without_a_clinicians_reason_can_be_ticked(client: TestClient, policies: list[int], judge: Judge) -> None:
    a, b, c = policies
    judge({a: judged(50.0), b: judged(60.0, **WORSE), c: judged(70.0, outcome_draws={"rating": share(0.3, 7.0, 1.0)})})
    page = client.get(PAGE).text
    assert {i: f'name="policy_ids" value="{i}"' in page for i in policies} == {a: True, b: False, c: True}


def test_the_keyboard_reaches_the_first_tick_in_fifteen_tabs(client: TestClient, policies: list[int], judge: Judge) -> None:
    judge({policy: judged(50.0) for policy in policies})
    page = client.get(PAGE).text
    before, after = page.split('id="candidates"')
    skips = before[: before.index('href="#candidates"')]
    way = after[: after.index('name="policy_ids"')]
    focusable = r"<(?:a|button|input(?! type=.hidden)|select|summary|textarea)\b"
    # A script makes a button of each head of a column. The way is: the links that skip, then from the table to its first tick
    assert len(re.findall(focusable, skips)) + len(re.findall(focusable, way)) + len(re.findall("<th\\b", way)) <= 15


def test_behaviours_that_are_cdbs_or_no_stimulation_by_another_name_are_folded(
    client: TestClient, policies: list[int], judge: Judge
) -> None:
    a, b, c = policies
    judge(
        {a: judged(50.0), b: judged(60.0, behaviour={"closeness_to_cdbs": 0.01}), c: judged(9.0, behaviour={"below_cdbs_20_percent": 0.95})}
    )
    page = client.get(PAGE).text
    assert "1 policy acts like cDBS" in page
    assert "1 policy acts like no stimulation" in page
    table = page[page.index("Expected change from cDBS") : page.index("1 policy acts like cDBS")]
    assert {i: f'/policies/{i}"' in table for i in policies} == {a: True, b: False, c: False}


def test_a_ranking_with_nothing_to_test_says_so_why_and_what_to_do(client: TestClient, policies: list[int], judge: Judge) -> None:
    a, b, c = policies
    off = {"behaviour": {"below_cdbs_20_percent": 0.95}}
    judge({a: judged(50.0, **WORSE), b: judged(60.0, behaviour={"closeness_to_cdbs": 0.01}), c: judged(9.0, **off)})
    words = first_screen(client)
    assert (
        "By prediction, no policy is worth a visit yet. At the next visit: random and cDBS sessions, "
        "from which better policies can be learned. Why: "
        "1 acts like cDBS, so that a session would show nothing new; the rest is not advised. Further policies are needed: train some ."
        in words
    )
    assert (
        "p0 : unsafe, > 99 % likely that grasp, rating or tremor is worse by more than twice its margin, most often tremor; "
        "to expect: energy \N{MINUS SIGN}40 %"
    ) in words
    assert "tremor +25 percentage points" in words, "what it would cost the patient"
    assert "p2 : acts like no stimulation, nearly off more than 80 % of the time" in words
    assert "To expect under cDBS itself (3 mA): grasp 2.0 Hz, rating 7.0 of 10 by the patient (10 is best), tremor 20 % of " in words
    assert "percentage points more (up to 30 % of the time). “Nearly off” is below " in words
    assert "Predicted from 12 recorded sessions." in words
    page = client.get(PAGE).text
    assert not re.search("tick policies|ticked policies|Skip to the candidates", page), "there is nothing to tick"


def test_another_method_can_order_the_fold_and_the_verdicts_stay(client: TestClient, policies: list[int], judge: Judge) -> None:
    a, b, _ = policies
    judge({a: judged(50.0), b: judged(60.0, **WORSE)})
    body = client.get(RANKING, params={"method": "posterior"}).json()
    assert [p["decision"] for p in body["policies"]] == ["test", "unsafe"]
    assert "Weights of the structures" in client.get(PAGE).text


def test_the_fold_tells_statistical_error_from_what_structures_get_wrong(client: TestClient, policies: list[int], judge: Judge) -> None:
    told = judged(50.0)
    told["details"]["standard_errors"] = {"statistical": 1.23, "model_error": 4.56}
    judge({policies[0]: told, policies[1]: judged(60.0)})
    page = flat(client.get(PAGE).text)
    (table,) = [part for part in page.split("<table")[1:] if "<caption>Standard errors of the posterior" in part]
    numbers = re.findall(r'<td class="num">([^<]*)</td>', table.split("</table>")[0])
    assert numbers == ["1.23", "4.56"], "the other estimate has none"
    assert "4.56" not in above_fold(page)


def test_the_fold_says_how_well_outcomes_of_a_day_to_come_are_predicted(client: TestClient, policies: list[int], judge: Judge) -> None:
    told = judged(50.0)
    grasp = {"session_error": 0.21, "session_skill": 0.9, "visit_error": 0.43, "visit_skill": 0.62}
    told["details"]["left_out_outcomes"] = {"grasp_hz": grasp, "rating": dict.fromkeys(grasp)}
    judge({policies[0]: told})
    page = flat(client.get(PAGE).text)
    (table,) = [part for part in page.split("<table")[1:] if "<caption>Errors of predicted outcomes" in part]
    rows = re.findall(r'<tr><td>([^<]*)</td><td class="num">([^<]*)</td><td class="num">([^<]*)</td><td class="num">([^<]*)</td>', table)
    assert rows == [("Grasp (Hz)", "0.21", "0.43", "0.62"), ("Rating (points)", "—", "—", "—")]
    assert "0.43" not in above_fold(page)


def test_a_serious_event_is_unsafe_without_a_posterior_and_of_a_retired_policy_too() -> None:
    given = Circumstances(1, datetime(2026, 1, 1, tzinfo=UTC), MarginsVersion(), MarginsVersion(), None, {}, Place(Bound(0.3)), None)
    found = decide({}, {}, "dlsm", given, 7, harms=(Flag("adverse_event"),))
    assert (found.decision, found.reasons[0].code) == ("unsafe", "adverse_event")
    retired = decide({}, {}, "dlsm", given, 7, retired_reason="replaced", harms=(Flag("adverse_event"),))
    assert retired.needs_override
    assert not decide({}, {}, "dlsm", given, 7, retired_reason="replaced").needs_override
