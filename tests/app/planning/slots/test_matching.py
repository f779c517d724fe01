"""Sessions of a visit in the slots of its plan."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta

from app.planning.slots.matching import Deviation, Done, Match, Planned, match
from app.tables.sessions import Controller

DAY = date(2026, 3, 2)
NINE = datetime(2026, 3, 2, 9, tzinfo=UTC)
PLAN = [
    Planned(i, controller, policy, 10.0)
    for i, (controller, policy) in enumerate(
        [(Controller.RL, 7), (Controller.CDBS, None), (Controller.RL, 8), (Controller.CDBS, None), (Controller.RL, 7)], start=1
    )
]


def done(number: int, controller: Controller | None, policy: int | None = None, minutes: float = 10.0, at: float | None = None) -> Done:
    return Done(number, controller, policy, 60 * minutes, None if at is None else NINE + timedelta(minutes=at))


def filled(found: list[Match]) -> list[int | None]:
    return [m.session_id for m in found if m.item_id is not None]


def test_a_whole_day_fills_every_slot_in_order_repeats_included() -> None:
    held = [done(20 + i, p.controller, p.policy_id, at=15 * i) for i, p in enumerate(PLAN)]
    found = match(PLAN, held, DAY)
    assert filled(found) == [20, 21, 22, 23, 24]
    assert {m.deviations for m in found} == {()}


def test_a_missing_session_leaves_its_slot_empty_and_a_stray_one_is_unplanned() -> None:
    held = [done(1, Controller.RL, 7), done(2, Controller.CDBS), done(3, Controller.RL, 8), done(5, Controller.RL, 7)]
    found = match(PLAN, [*held, done(6, Controller.RANDOM)], DAY)
    assert filled(found) == [1, 2, 3, None, 5]
    assert found[3].deviations == (Deviation.MISSING,)
    assert found[-1] == Match(None, 6, (Deviation.UNPLANNED,))


def test_the_clinic_days_times_say_which_of_two_cdbs_sessions_is_missing() -> None:
    slots = [Planned(p.item_id, p.controller, p.policy_id, p.minutes, NINE + timedelta(minutes=70 * i)) for i, p in enumerate(PLAN)]
    held = [done(1, Controller.RL, 7, at=1), done(4, Controller.CDBS, at=211)]
    assert filled(match(slots, held, DAY)) == [1, None, None, 4, None]


def test_recordings_whose_clock_is_an_hour_off_find_their_slots_and_are_said_to_be() -> None:
    slots = [Planned(p.item_id, p.controller, p.policy_id, p.minutes, NINE + timedelta(minutes=20 * i)) for i, p in enumerate(PLAN)]
    for off in (60, -60, 61):  # summer time either way, and a drift besides
        held = [done(20 + i, None, at=off + 20 * i + 1) for i in range(5)]
        found = match(slots, held, DAY)
        assert filled(found) == [20, 21, 22, 23, 24], off
        assert {m.deviations for m in found} == {(Deviation.OTHER_TIME,)}
    right = match(slots, [done(20 + i, None, at=20 * i + 1) for i in range(5)], DAY)
    assert (filled(right), {m.deviations for m in right}) == ([20, 21, 22, 23, 24], {()})
    late = match(slots, [done(22, None, at=41), done(23, None, at=61), done(24, None, at=81)], DAY)
    assert filled(late) == [None, None, 22, 23, 24], "an hour is not supposed where the clock explains as much"


def test_an_hour_is_not_supposed_of_clocks_that_are_minutes_apart() -> None:
    kinds = [(Controller.RL, 7), (Controller.CDBS, None)] * 3
    for spacing in (25, 35):
        slots = [Planned(i, kind, policy, 20.0, NINE + timedelta(minutes=spacing * (i - 1))) for i, (kind, policy) in enumerate(kinds, 1)]
        for off in (11, 12, -12, -13, -15):
            held = [done(20 + i, None, minutes=20, at=spacing * i + off) for i in range(6)]
            found = match(slots, held, DAY)
            assert filled(found) == [20, 21, 22, 23, 24, 25], (spacing, off)
            assert {m.deviations for m in found} == {(Deviation.OTHER_TIME,)}
            part = match(slots, held[2:], DAY)  # at 13 of 25 minutes the neighbour's slot is the closer one
            assert abs(off) > 12 or filled(part) == [None, None, 22, 23, 24, 25], (spacing, off)
        for off in (59, 61, -59, -61):
            held = [done(20 + i, None, minutes=20, at=spacing * i + off) for i in range(6)]
            assert filled(match(slots, held, DAY)) == [20, 21, 22, 23, 24, 25], (spacing, off)


def test_a_log_of_a_tablet_whose_clock_is_fast_fills_its_slot_and_is_said_to_be_off() -> None:
    slots = [Planned(p.item_id, p.controller, p.policy_id, p.minutes, NINE + timedelta(minutes=20 * i)) for i, p in enumerate(PLAN)]
    logs = [
        Done(30 + i, p.controller, p.policy_id, 600.0, NINE + timedelta(minutes=60 + 20 * i), logged=p.item_id) for i, p in enumerate(PLAN)
    ]
    found = match(slots, logs, DAY)
    assert filled(found) == [30, 31, 32, 33, 34]
    assert {m.deviations for m in found} == {(Deviation.OTHER_TIME,)}


def test_open_sessions_take_the_place_that_their_order_leaves() -> None:
    held = [done(1, None), done(2, Controller.CDBS), done(3, None), done(4, Controller.CDBS), done(5, None)]
    assert filled(match(PLAN, held, DAY)) == [1, 2, 3, 4, 5]


def test_another_policy_or_controller_never_fills_a_slot() -> None:
    found = match(PLAN[:1], [done(1, Controller.RL, 9), done(2, Controller.DISTILLED, 7)], DAY)
    assert filled(found) == [None]
    assert [m.session_id for m in found[1:]] == [1, 2]


def test_policies_in_another_order_are_matched_and_said() -> None:
    slots = [PLAN[0], PLAN[2]]
    found = match(slots, [done(1, Controller.RL, 8), done(2, Controller.RL, 7)], DAY)
    assert sorted(filled(found), key=str) == [1, 2]
    assert [m.session_id for m in found if m.item_id == 1] == [2]
    assert sum(Deviation.OUT_OF_ORDER in m.deviations for m in found) == 1


def test_length_and_day_are_held_against_the_plan() -> None:
    slots = PLAN[:3]
    last_year = Done(3, Controller.RL, 8, 600.0, NINE - timedelta(days=365))
    found = match(slots, [done(1, Controller.RL, 7, minutes=4), done(2, Controller.CDBS, minutes=13), last_year], DAY)
    assert [m.deviations for m in found] == [(Deviation.SHORTER,), (Deviation.LONGER,), (Deviation.OTHER_DAY,)]


def test_what_somebody_confirmed_stays() -> None:
    held = [Done(1, Controller.CDBS, None, 600.0, None, filled=4), done(2, Controller.CDBS)]
    assert filled(match(PLAN, held, DAY)) == [None, 2, None, 1, None]


def test_an_attempt_that_ended_before_its_policy_decided_leaves_the_slot_to_the_next_one() -> None:
    early = Done(1, Controller.RL, 7, 14.0, NINE, logged=1, aborted=True)
    found = match(PLAN, [early], DAY)
    assert filled(found) == [None] * 5
    assert found[-1] == Match(None, 1, (Deviation.ABORTED,))
    again = Done(2, Controller.RL, 7, 600.0, NINE + timedelta(minutes=3), logged=1)
    found = match(PLAN, [early, again], DAY)
    assert filled(found) == [2, None, None, None, None]
    assert found[-1] == Match(None, 1, (Deviation.ABORTED,))
