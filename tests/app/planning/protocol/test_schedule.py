"""The rules of a visit day."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.planning.protocol.schedule import (
    Candidate,
    Order,
    PlannedSession,
    Rule,
    Rules,
    cdbs_sessions,
    most_policies,
    schedule,
    total_minutes,
)
from app.platform.errors import Invalid
from app.tables.sessions import Controller

LEARNED = {Controller.RL, Controller.DISTILLED}

candidates = st.lists(st.sampled_from(sorted(LEARNED)), min_size=1, max_size=4).map(
    lambda kinds: [Candidate(100 + i, kind) for i, kind in enumerate(kinds)]
)
rules = st.builds(
    Rules,
    session_minutes=st.floats(5, 20),
    washout_minutes=st.floats(0, 30),
    total_minutes=st.floats(10, 600),
    no_dbs=st.booleans(),
    no_dbs_minutes=st.just(5.0),
    repeats=st.integers(1, 3),
    order=st.sampled_from(list(Order)),
    block=st.integers(0, 20),
    break_minutes=st.sampled_from([0.0, 20.0]),
    random_sessions=st.integers(0, 4),
)


def end_minute(session: PlannedSession) -> float:
    """Return when it ends, before its washout."""
    return session.start_minute + session.minutes


@given(candidates, rules, st.integers(0, 2**31 - 1))
def test_every_day_that_is_laid_out_keeps_every_rule(chosen: list[Candidate], rules: Rules, seed: int) -> None:
    if most_policies(rules) < len(chosen):
        with pytest.raises(Invalid) as refusal:
            schedule(chosen, rules, seed)
        assert refusal.value.extra["minutes_needed"] > rules.total_minutes
        return
    day = schedule(chosen, rules, seed)
    learned = [i for i, s in enumerate(day) if s.controller in LEARNED]
    assert sorted(day[i].policy_id or 0 for i in learned) == sorted([c.policy_id for c in chosen] * rules.repeats)
    assert {day[i].policy_id: day[i].controller for i in learned} == {c.policy_id: c.controller for c in chosen}
    for i, j in pairwise(learned):
        assert Controller.CDBS in [s.controller for s in day[i:j]]
    assert sum(s.controller is Controller.CDBS for s in day) == max(1, len(chosen) * rules.repeats - 1)
    assert sum(s.controller is Controller.RANDOM for s in day) == rules.random_sessions
    assert [s.controller for s in day].count(Controller.NO_DBS) == rules.no_dbs
    assert not rules.no_dbs or day[-1].controller is Controller.NO_DBS
    assert day[0].start_minute == 0
    for one, two in pairwise(day):
        assert two.start_minute == pytest.approx(end_minute(one) + rules.washout_minutes + one.break_minutes)
    assert sum(s.break_minutes for s in day) == (rules.break_minutes if len(day) > 1 else 0)
    assert day[-1].break_minutes == 0
    assert all(5 <= s.minutes <= 20 for s in day)
    assert day[-1].washout_minutes == 0
    assert end_minute(day[-1]) <= rules.total_minutes + 1e-6
    assert end_minute(day[-1]) == pytest.approx(total_minutes(len(chosen), rules))
    assert sum(s.controller is Controller.CDBS for s in day) == cdbs_sessions(len(chosen) * rules.repeats)
    assert schedule(chosen, rules, seed) == day


def test_four_policies_as_in_the_paper_take_a_hundred_minutes() -> None:
    day = schedule([Candidate(i, Controller.RL) for i in range(4)], Rules(), seed=7)
    assert [s.controller for s in day] == ["rl", "cdbs", "rl", "cdbs", "rl", "cdbs", "rl"]
    assert [s.start_minute for s in day] == [0, 15, 30, 45, 60, 75, 90]
    assert end_minute(day[-1]) == 100


def test_a_single_policy_has_its_cdbs_control_too() -> None:
    assert [s.controller for s in schedule([Candidate(1, Controller.DISTILLED)], Rules(), seed=1)] == ["cdbs", "distilled"]


def test_the_seed_draws_the_order() -> None:
    chosen = [Candidate(i, Controller.RL) for i in range(4)]
    orders = {tuple(s.policy_id for s in schedule(chosen, Rules(), seed) if s.policy_id is not None) for seed in range(200)}
    assert len(orders) == 24  # every order of four comes up


def test_a_day_that_is_too_long_says_how_many_policies_fit() -> None:
    tight = Rules(total_minutes=60)
    assert most_policies(tight) == 2
    with pytest.raises(Invalid) as refusal:
        schedule([Candidate(i, Controller.RL) for i in range(4)], tight, seed=0)
    assert refusal.value.detail == "4 policies with the sessions around them take 100 minutes; the visit has 60."
    assert refusal.value.hint == "Choose at most 2 policies, or shorten sessions or washout, or give the visit more minutes."
    schedule([Candidate(i, Controller.RL) for i in range(2)], tight, seed=0)


def test_a_day_too_short_for_any_policy_says_so() -> None:
    with pytest.raises(Invalid, match=r"Not even one policy fits.*leave out the no-DBS session and random sessions"):
        schedule([Candidate(1, Controller.RL)], Rules(total_minutes=20, no_dbs=True, random_sessions=1), seed=0)


def test_the_same_policy_twice_and_none_at_all_are_refused() -> None:
    with pytest.raises(Invalid, match="Policy 3 is named twice"):
        schedule([Candidate(3, Controller.RL), Candidate(3, Controller.RL)], Rules(), seed=0)
    with pytest.raises(Invalid, match="at least one policy, or one random or held session"):
        schedule([], Rules(), seed=0)


def test_an_early_visit_without_policies_is_random_sessions_after_one_of_cdbs() -> None:
    day = schedule([], Rules(random_sessions=3, no_dbs=True), seed=3)
    assert [s.controller for s in day] == ["cdbs", "random", "random", "random", "no_dbs"]
    assert end_minute(day[-1]) == pytest.approx(total_minutes(0, Rules(random_sessions=3, no_dbs=True)))
    with pytest.raises(Invalid, match=r"The random sessions .* take 130 minutes") as refusal:
        schedule([], Rules(random_sessions=8), seed=3)
    assert refusal.value.hint.startswith("Plan fewer of them, or shorten sessions or washout")


@pytest.mark.parametrize("minutes", [4.9, 20.1])
def test_sessions_outside_the_papers_five_to_twenty_minutes_are_refused(minutes: float) -> None:
    with pytest.raises(Invalid, match="5 to 20 minutes"):
        Rules(session_minutes=minutes)
    with pytest.raises(Invalid, match="5 to 20 minutes"):
        Rules(no_dbs_minutes=minutes)


def test_five_policies_are_refused_and_the_rule_is_named() -> None:
    with pytest.raises(Invalid, match="the protocol tests 2 to 4") as refusal:
        schedule([Candidate(i, Controller.RL) for i in range(5)], Rules(total_minutes=900), seed=0)
    assert refusal.value.extra["rule"] == Rule.POLICIES


def test_a_session_without_stimulation_is_no_longer_than_another() -> None:
    with pytest.raises(Invalid, match="Make it short: 5 to 8 minutes") as refusal:
        Rules(session_minutes=8, no_dbs=True, no_dbs_minutes=10)
    assert refusal.value.extra["rule"] == Rule.NO_DBS_SHORT


def test_policies_are_repeated_within_a_visit_in_whole_rounds() -> None:
    day = schedule([Candidate(i, Controller.RL) for i in (1, 2)], Rules(repeats=2, order=Order.WILLIAMS, break_minutes=15), seed=1)
    tested = [s.policy_id for s in day if s.policy_id]
    assert [s.controller for s in day] == ["rl", "cdbs"] * 3 + ["rl"]
    assert sorted(tested[:2]) == sorted(tested[2:]) == [1, 2]
    assert tested[:2] != tested[2:], "the second round takes the square's next row"
    assert [s.break_minutes for s in day] == [0, 0, 0, 15, 0, 0, 0]
    assert end_minute(day[-1]) == total_minutes(2, Rules(repeats=2, break_minutes=15)) == 7 * 10 + 6 * 5 + 15


def test_held_sessions_stand_and_count_as_random_ones_and_a_refusal_names_them() -> None:
    day = schedule([Candidate(7, Controller.RL), Candidate(8, Controller.RL)], Rules(held_sessions=2), seed=3)
    assert [s.controller for s in day].count(Controller.RANDOM) == 2
    assert end_minute(day[-1]) == pytest.approx(total_minutes(2, Rules(random_sessions=2)))
    assert Rules(random_sessions=1, held_sessions=2).exploring == 3
    with pytest.raises(Invalid, match="The random and held sessions") as refusal:
        schedule([], Rules(random_sessions=4, held_sessions=4), seed=3)
    assert refusal.value.hint.startswith("Plan fewer of them")
