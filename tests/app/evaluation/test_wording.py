"""Sentences are made at the end: other words change no rank, no support and no decision, and every code has its sentence."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.evaluation import wording
from app.evaluation.ranking import verdict_wording
from app.platform.kept import forget
from ml.ope.flags import Flag, distinct, not_counted_tests
from ml.ope.posterior.verdict import Levels, verdict
from ml.ope.support.coverage import thin
from ml.qoc import Margins
from tests.app.evaluations import judged
from tests.app.words import methods_named
from tests.ml.ope.posterior.draws import N, cdbs, constructed

RANKING = "/api/v1/participants/P1/ranking"
NEARLY_OFF = {"below_cdbs_20_percent": 0.5}
WORDS = ("text", "decision_reason", "reason", "notes", "stale_reasons", "stale_reason", "standing")


def without_words(found: Any) -> Any:
    """Copy an answer of the API without what is for people."""
    if isinstance(found, dict):
        return {name: without_words(v) for name, v in found.items() if name not in WORDS}
    return [without_words(v) for v in found] if isinstance(found, list) else found


def test_reworded_sentences_change_no_rank_support_or_decision(
    client: TestClient, policies: list[int], judge: Callable[..., int], monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b, c = policies
    judge({a: judged(60.0), b: judged(50.0, supported=False, support={"lowest_supported": None}), c: judged(30.0, behaviour=NEARLY_OFF)})
    before = client.get(RANKING).json()
    assert [p["decision"] for p in before["policies"]] == ["test", "undecided", "unsafe"]
    page = client.get("/participants/P1/ranking").text
    for words in (wording, verdict_wording):
        for name, _ in inspect.getmembers(words, inspect.isfunction):
            if not name.endswith("_out"):  # those put words into types of the interface
                monkeypatch.setattr(words, name, lambda *_, **__: "x")
    monkeypatch.setattr(wording, "_SENTENCES", {})
    monkeypatch.setattr(verdict_wording, "_PLAINLY", {})
    forget()  # other words are other code, which begins with nothing in memory
    after = client.get(RANKING).json()
    assert {f["text"] for p in after["policies"] for f in p["flags"]} == {p["decision_reason"] for p in after["policies"]} == {"x"}
    assert without_words(after) == without_words(before)
    reworded = client.get("/participants/P1/ranking").text
    assert reworded.count("not supported") >= 1
    assert [page.count(f'value="{i}"') for i in policies] == [reworded.count(f'value="{i}"') for i in policies]


def test_every_code_that_the_science_or_a_rule_makes_has_a_sentence() -> None:
    root = Path(wording.__file__).parents[2]
    sources = [*(root / "ml/ope").rglob("*.py"), *(root / "app/evaluation").rglob("*.py")]
    made = {code for path in sources for code in re.findall(r'(?:Flag|Flag\.of|few_effective)\(\s*"([a-z_]+)"', path.read_text())}
    assert {"thin", "far", "beyond_margin", "sessions_needed", "few_effective_sessions"} <= made
    assert made <= set(wording._SENTENCES)


def test_flags_survive_their_stored_form_and_are_told_once() -> None:
    flag = Flag.of("usual_order", 0.25, None, "share", refuses=True, source="simulated", methods=("fqe", "linear"), low=0.1, widened=False)
    assert Flag.from_json(flag.to_json()) == flag
    one, alike, other = (thin(share, "logged", low=0.3, high=1.0) for share in (0.301, 0.302, 0.34))
    assert distinct([one, alike, other, thin(0.301, "simulated", low=0.3, high=1.0)]) == (
        one, other, thin(0.301, "simulated", low=0.3, high=1.0)
    )  # fmt: skip


def test_the_reasons_of_a_verdict_read_as_one_sentence_and_plainly() -> None:
    reasons = [Flag("undecided"), Flag("within_margins", 0.7, 0.8, "probability"), Flag("sessions_needed", 3.0, None, "sessions")]
    reasons.append(Flag("near_amplitude", 1.8, None, "mA"))
    assert verdict_wording.decision(reasons) == (
        "neither likely enough to be within the margins nor likely enough to be beyond one; 70 % likely within the "
        "margins of grasp, rating and tremor (a test asks for 80 %); 3 sessions held near 1.8 mA would tell"
    )
    assert verdict_wording.plainly(reasons) == (
        "not sure enough: a test asks for 80 % likely no worse; 3 sessions held near 1.8 mA would tell"
    )
    unsure = [Flag("undecided"), Flag("within_margins", 0.9, 0.8, "probability"), Flag("saves_energy", 0.7, 0.9, "probability")]
    assert verdict_wording.plainly(unsure) == "not sure enough: a test asks for 90 % likely to use less energy"
    assert verdict_wording.plainly([Flag("extrapolates", 0.4, 0.5)], 0.5, 1.5) == "lower than two sessions ever held: not below 1.5 mA"
    assert (
        verdict_wording.plainly([Flag("extrapolates", 0.4, 0.5)], 0.5)
        == "lower than two sessions ever held: not below 50 % of the cDBS amplitude"
    )


def test_draws_show_no_probability_of_nothing_or_of_certainty() -> None:
    assert [wording.chance(p) for p in (0.0, 0.004, 0.5, 0.987, 1.0)] == ["< 1 %", "< 1 %", "50 %", "99 %", "> 99 %"]


SILENT = {"within_margins", "saves_energy", "extrapolates"}
"""Codes that need no sentence of their own on a first screen: columns have both chances, and a test with care says its lowest amplitude."""
FACTS = {
    "outcome": "tremor_percent",
    "text": "the file is gone",
    "reasons": ("no_better_than_equal",),
    "low": 0.3,
    "high": 1.0,
    "times": 2.0,
}


def codes_of_verdicts() -> set[str]:
    """Collect every code that a verdict may rest on, by the sources that make them."""
    root = Path(wording.__file__).parents[2]
    sources = ["ml/ope/posterior/verdict.py", "ml/ope/posterior/support.py", "app/evaluation/ranking/decisions.py"]
    made = {code for path in sources for code in re.findall(r'(?:Flag|Flag\.of)\(\s*"([a-z_]+)"', (root / path).read_text())}
    refusing = re.findall(r'Flag\.of\(\s*"([a-z_]+)"[^\n]*refuses=True', (root / "ml/ope/support/diagnostics.py").read_text())
    return made | set(refusing) | {"thin"}


def test_every_reason_of_a_verdict_is_told_in_a_clinicians_words() -> None:
    codes = codes_of_verdicts()
    assert {"adverse_event", "nearly_off", "few_near_visits", "not_settled_by_sessions", "outside_range", "energy_unknown"} <= codes
    assert set(verdict_wording._PLAINLY) - {"unseen_dose", "below_random_bound"} <= codes, "what no verdict rests on needs no words here"
    told = {}
    for code in sorted(codes - SILENT - set(verdict_wording._FURTHER)):
        flag = Flag.of(code, 0.42, 0.8, "share", **FACTS)
        told[code] = verdict_wording.plainly([flag])
        assert verdict_wording.decision([flag]), code
    assert [code for code, words in told.items() if not words] == []
    assert [words for words in told.values() if methods_named(words) or re.search(r"_|nan|None|step|estimat|probab|simulat", words)] == []
    assert len(set(told.values())) == len(told), "no two codes read the same"
    assert told["nearly_off"] == "nearly off 42 % of the time"
    further = [Flag("sessions_needed", 3.0, None, "sessions"), Flag("near_amplitude", 1.8, None, "mA"), Flag("visits_needed", 2.0)]
    assert verdict_wording.plainly(further) == "3 sessions held near 1.8 mA on 2 visits would tell"


def test_the_strongest_reason_stands_first() -> None:
    off = {"below_cdbs_20_percent": 0.42}
    own = constructed(behaviour=off, outcome_draws={"tremor_percent": [45.0] * N})
    found = verdict(own, cdbs(), Margins(0.1, 1.0, 10.0), Levels(), harms=(Flag("adverse_event"),))
    assert [reason.code for reason in found.hazards] == ["adverse_event", "nearly_off", "beyond_margin"]
    assert verdict_wording.plainly(found.hazards).startswith(
        "serious adverse event, not cleared by a clinician; nearly off 42 % of the time"
    )
    without = verdict(own, cdbs(), Margins(0.1, 1.0, 10.0), Levels())
    assert verdict_wording.plainly(without.hazards) == (
        "nearly off 42 % of the time; > 99 % likely that grasp, rating or tremor is worse by more than twice its margin, most often tremor"
    )


def test_tests_that_do_not_count_are_told_with_their_reasons() -> None:
    assert not_counted_tests() is None
    flag = not_counted_tests(without_cdbs=2, without_policy=1)
    assert flag is not None
    assert wording.sentence(flag) == (
        "3 sessions of tested policies not counted in full: 2 at a visit without cDBS, "
        "1 of a policy that cannot be replayed, because its file is gone or it takes other windows"
    )
