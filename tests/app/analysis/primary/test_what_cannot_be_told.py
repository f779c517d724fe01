"""Ties, one session, one visit, nothing measured: each has a reason of its own, and each reason a sentence of its own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import UTC, datetime

import pytest

from app.analysis import primary_words
from app.analysis.facts import RESOLUTION, Facts
from app.analysis.primary_verdict import LockedMargins, NoVerdict, VerdictResult, verdicts
from app.overview import recompute
from app.study.blinding import Arm
from app.tables.sessions import Controller
from ml.qoc import Margins, failed_qoc
from ml.statistics.noninferiority import Inconclusive, NonInferiorAndSaving
from ml.statistics.within_visits.contrasts import Reason, Unavailable

NOW = datetime(2026, 3, 2, tzinfo=UTC)
LOCKED = LockedMargins(Margins(), 1, datetime(2026, 1, 1, tzinfo=UTC), "test")
CDBS, RL = Controller.CDBS, Controller.RL
SAME = {"energy": 0.5, "grasp": 2.4, "rating": 7.0, "tremor": 10.0}
VARIED = {"energy": (0.5, 0.52, 0.55, 0.49), "grasp": (2.4, 2.45, 2.38, 2.5), "rating": (7, 8, 7, 6), "tremor": (10.0, 12.0, 9.0, 10.5)}


def session(number: int, visit: int, controller: Controller, values: Mapping[str, float | None]) -> Facts:
    known = {name: float(value) for name, value in values.items() if value is not None}
    if controller is CDBS and "energy" in known:
        known["energy"] = 1.0
    return Facts(number, visit, visit, number, Arm(controller, None), None, None, NOW, 300.0, known, {}, None, None, (), None, None)


def study(values: Iterable[Mapping[str, float | None]], each: int = 2) -> list[Facts]:
    """Build one visit for each entry, so many sessions of either arm in it."""
    planned = [(visit, c, v) for visit, v in enumerate(values, start=1) for _ in range(each) for c in (CDBS, RL)]
    return [session(i, *p) for i, p in enumerate(planned)]


def varied(visits: int, **fixed: float | None) -> list[Facts]:
    """Build sessions that differ from each other, but for what is given."""
    made = study([SAME] * visits, each=4)
    for k, s in enumerate(made):
        values = {name: v[(7 * k + s.visit * (k % 3)) % 4] for name, v in VARIED.items()} | fixed
        made[k] = session(k, s.visit, s.controller, values)
    return made


def judged(sessions: list[Facts]) -> VerdictResult:
    (found,) = verdicts(sessions, [RL], LOCKED, failed_qoc([]))
    return found


def open_verdict(sessions: list[Facts]) -> Inconclusive:
    found = judged(sessions)
    assert found.assessment is not None
    assert isinstance(found.assessment.verdict, Inconclusive)
    return found.assessment.verdict


def test_where_all_sessions_are_equal_the_outcome_without_steps_is_named() -> None:
    found = open_verdict(study([SAME] * 6))
    assert found.open == ("grasp",)
    assert found.untested == found.unplanned == (("grasp", Reason.ALL_EQUAL),)
    assert found.more_visits is None


def test_where_days_differ_and_arms_do_not_the_difference_is_what_never_varies() -> None:
    # binary fractions, so that a visit's difference is exactly the same
    days = [SAME | {"grasp": 2.0 + 0.25 * v} for v in range(6)]
    same_ratio = [replace(s, values=s.values | {"grasp": s.values["grasp"] * (0.9 if s.controller is RL else 1.0)}) for s in study(days)]
    assert open_verdict(same_ratio).untested == (("grasp", Reason.NO_VARIANCE),)


def test_one_session_of_either_arm_at_one_visit_tells_no_spread() -> None:
    found = open_verdict(study([SAME], each=1))
    assert {why for _, why in found.untested} == {Reason.TOO_FEW_VISITS}
    assert dict(found.unplanned) == {"grasp": Reason.TOO_FEW_SESSIONS, "tremor": Reason.TOO_FEW_SESSIONS, "energy": Reason.TOO_FEW_SESSIONS}


def test_one_visit_concludes_nothing_and_tells_how_many_more_it_takes() -> None:
    found = open_verdict(varied(1))
    assert found.untested == tuple((name, Reason.TOO_FEW_VISITS) for name in ("grasp", "rating", "tremor"))
    assert not found.unplanned


@pytest.mark.parametrize("missing", ["rating", "tremor"])
def test_what_was_never_measured_is_named_and_nothing_else(missing: str) -> None:
    found = open_verdict(varied(6, **{missing: None}))
    assert found.untested == found.unplanned == ((missing, Reason.NO_SESSION),)


def test_without_energy_no_number_of_visits_is_promised_or_denied() -> None:
    found = open_verdict(varied(6, energy=None))
    assert found.open == ("energy",)
    assert found.untested == found.unplanned == (("energy", Reason.NO_SESSION),)


def test_an_outcome_of_two_visits_is_told_from_a_study_of_two_visits() -> None:
    some = [s if s.visit < 3 else replace(s, values={k: v for k, v in s.values.items() if k != "tremor"}) for s in varied(6)]
    found = open_verdict(some)
    assert found.untested == (("tremor", Reason.TOO_FEW_VISITS),)
    sentence, short = primary_words.verdict(judged(some)), primary_words.verdict(judged(varied(2)))
    assert primary_words.NAMES["tremor"] in sentence.split(";", 1)[1]
    assert primary_words.NAMES["tremor"] not in short.split(";", 1)[1]


def test_no_grasp_frequency_to_take_a_share_of_gives_no_verdict() -> None:
    for grasp in (None, 0.0):
        assert judged(varied(6, grasp=grasp)).no_verdict is NoVerdict.NO_REFERENCE
    assert judged([s for s in varied(6) if s.controller is RL]).no_verdict is NoVerdict.NO_REFERENCE


def test_a_participant_who_never_trembles_gets_a_verdict() -> None:
    found = judged(varied(6, tremor=0.0)).assessment
    assert found is not None
    assert isinstance(found.verdict, NonInferiorAndSaving)
    assert found.outcomes[2].p_non_inferior is not None


def test_each_reason_has_a_sentence_of_its_own() -> None:
    assert len({primary_words.unavailable(Unavailable(r, 1, 2)) for r in Reason}) == len(Reason)
    asked = [Inconclusive(("tremor",), None, ((("tremor", r),))) for r in Reason] + [Inconclusive(("tremor",), None)]
    sentences = {primary_words.verdict_sentence("RL", found, 5, planned=True) for found in asked}
    assert len(sentences) == len(Reason) + 1
    assert all(s.endswith(".") and ".." not in s and ". " not in s for s in sentences)
    # nothing is reported about further visits where it was not requested, but what could not be tested is
    beyond, tied = Inconclusive(("grasp",), None), Inconclusive(("grasp",), None, (("grasp", Reason.ALL_EQUAL),))
    assert ";" not in primary_words.verdict_sentence("RL", beyond, 5, planned=False)
    assert ";" in primary_words.verdict_sentence("RL", tied, 5, planned=False)


def test_the_script_of_the_data_package_takes_the_step_of_energy_of_the_service() -> None:
    assert RESOLUTION["energy"] == recompute.ENERGY_RESOLUTION
