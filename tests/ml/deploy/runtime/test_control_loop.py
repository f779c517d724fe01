"""The control loop under all faults of a link, a device and a tablet: cDBS within one period, and a last line that says so."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ml.deploy.runtime.control_loop import End
from ml.deploy.runtime.controller import BoundedController
from ml.deploy.runtime.decision_log import LogFailed, Row
from ml.deploy.runtime.device import DeviceSide
from ml.deploy.runtime.envelope import Reason
from ml.deploy.runtime.inputs import Event
from tests.ml.deploy.runtime.links import (
    CDBS,
    HELLO,
    LIMITS,
    PERIOD,
    SIGNAL,
    ScriptedLink,
    W,
    beta_line,
    betas,
    followed,
    network,
    ran,
    session,
)


def returns_to_cdbs_within(link: ScriptedLink, from_s: float, seconds: float) -> None:
    """Require that the first amplitude after a fault is cDBS, and comes in time."""
    assert any(ma < CDBS for at, ma in link.amplitudes if at < from_s), "the network had taken over before"
    at, ma = next((at, ma) for at, ma in link.amplitudes if at >= from_s)
    assert ma == CDBS
    assert at - from_s <= seconds + 1e-9


def test_the_network_takes_over_after_a_whole_window_and_moves_within_the_ramp() -> None:
    link, one, end = ran(betas(range(12)), 24.5)
    assert followed(one) == [False] * (W - 1) + [True] * 10 + [False]
    amplitudes = [ma for _, ma in link.amplitudes]
    assert amplitudes == pytest.approx([3.0, 3.0, 1.5, *[0.6] * 9])
    assert [at for at, _ in link.amplitudes] == pytest.approx([PERIOD * k for k in range(1, 13)])
    assert end is End.INPUT_ENDED
    assert link.sent[0][1] == "controller 1 P1 left 2000 3 0.6 3 2\n"
    assert link.sent[-1][1].split()[0::3] == ["end", "3"]


@pytest.mark.hazard("H07")
def test_silence_gives_cdbs_within_a_period_of_when_beta_was_due() -> None:
    link, one, _ = ran([*betas(range(8)), *betas(range(8, 8))], 40.0)
    returns_to_cdbs_within(link, 16.1, PERIOD * 1.2)
    silent = [d for d in one.decisions if d.t_s > 17]
    assert len(silent) >= 10, "a decision in every period"
    assert all(d.amplitude_ma == CDBS and d.reasons & Reason.STALE_BETA for d in silent[:-1])


@pytest.mark.hazard("H07")
def test_a_device_that_never_speaks_leaves_cdbs_in_every_period() -> None:
    link, one, _ = ran([], 21.0)
    assert [ma for _, ma in link.amplitudes] == [CDBS] * len(link.amplitudes)
    assert len(link.amplitudes) == 10
    assert all(d.reasons & Reason.NO_BETA for d in one.decisions[:-1])


@pytest.mark.hazard("H07")
def test_a_value_that_comes_a_period_late_is_never_taken_for_a_present_one() -> None:
    late = [(PERIOD * (k + 1) + 2.2, Event.LINE, beta_line(k)) for k in range(8, 16)]
    link, one, _ = ran([*betas(range(8)), *late], 40.0)
    returns_to_cdbs_within(link, 16.1, PERIOD * 1.2)
    assert not any(followed(one)[8:]), "every later value is as old"


@pytest.mark.hazard("H07")
def test_one_value_that_is_merely_late_costs_one_decision_and_not_the_window() -> None:
    _, one, _ = ran([*betas(range(8)), (18.9, Event.LINE, beta_line(8)), *betas(range(9, 14))], 30.0)
    assert followed(one) == [False] * 2 + [True] * 6 + [False] + [True] * 5 + [False]


@pytest.mark.hazard("H07", "H11")
def test_at_five_per_cent_of_messages_lost_the_policy_decides_nine_times_in_ten_and_never_on_stale_beta() -> None:
    lost, n = np.random.default_rng(4).random(2000) < 0.05, 2000
    limits = replace(LIMITS, window=10, most_imputed=2, frozen_after=None)
    link = ScriptedLink([(0.0, Event.LINE, HELLO), *betas(k for k in range(n) if not lost[k]), (PERIOD * n + 0.5, Event.ENDED, "")])
    rows: list[Row] = []
    one = session(link, rows, BoundedController(network(10), limits, SIGNAL))
    one.run()
    assert sum(followed(one)) / len(one.decisions) >= 0.9
    stale = [row for row in rows if row.sample is None and row.ended is None]
    assert len(stale) == lost.sum()
    assert all(row.decision.fallback and row.decision.amplitude_ma == CDBS for row in stale)
    assert not any(row.decision.reasons & Reason.LINK for row in rows), "a number that was lost is no fault of the link"


@pytest.mark.hazard("H08")
@pytest.mark.parametrize("wrong", [math.nan, -1.0, math.inf, 1e39])
def test_a_value_that_is_no_amplitude_gives_cdbs_in_its_own_decision(wrong: float) -> None:
    link, one, _ = ran([*betas(range(8)), *betas([8], beta=wrong), *betas(range(9, 14))], 30.0)
    returns_to_cdbs_within(link, 18.0, 0.0)
    assert one.decisions[8].reasons & Reason.INVALID_BETA
    assert followed(one)[8:] == [False] * (1 + W - 1) + [True] * 3 + [False]


@pytest.mark.hazard("H09")
def test_saturated_beta_gives_cdbs_in_its_own_decision() -> None:
    link, one, _ = ran([*betas(range(8)), *betas([8], beta=9.5)], 20.0)
    returns_to_cdbs_within(link, 18.0, 0.0)
    assert one.decisions[8].reasons & Reason.SATURATED_BETA


@pytest.mark.hazard("H10")
def test_frozen_beta_gives_cdbs_when_it_has_come_four_times() -> None:
    link, one, _ = ran([*betas(range(8)), *betas(range(8, 16), beta=1.5)], 34.0)
    assert followed(one)[8:11] == [True] * 3
    assert not any(followed(one)[11:])
    assert one.decisions[11].reasons & Reason.FROZEN_BETA
    assert link.amplitudes[11][1] == CDBS


@pytest.mark.hazard("H03")
@pytest.mark.parametrize("factor", [10.0, 0.1, 1000.0, 0.001])
def test_beta_in_a_unit_ten_times_off_never_reaches_the_network(factor: float) -> None:
    _, one, _ = ran([(PERIOD * (k + 1), Event.LINE, beta_line(k, beta=factor * (1 + 0.01 * (k % 5)))) for k in range(12)], 25.0)
    assert not any(followed(one))
    assert one.decisions[-2].reasons & (Reason.BETA_LEVEL | Reason.SATURATED_BETA)


@pytest.mark.hazard("H03")
@pytest.mark.parametrize("said", ["mV time_domain", "uV device_power", "uV2 time_domain"])
def test_beta_that_says_another_unit_or_source_gives_cdbs(said: str) -> None:
    link, one, _ = ran([*betas(range(8)), *betas(range(8, 12), said=said)], 26.0)
    returns_to_cdbs_within(link, 18.0, 0.0)
    assert not any(followed(one)[8:])
    assert one.decisions[8].reasons & Reason.WRONG_SIGNAL


@pytest.mark.hazard("H02")
@pytest.mark.parametrize(
    ("hello", "what"),
    [
        ("hello 1 P1 right uV time_domain 2000", "side right instead of left"),
        ("hello 1 P2 left uV time_domain 2000", "participant P2 instead of P1"),
        ("hello 1 P1 left mV time_domain 2000", "unit mV instead of uV"),
        ("hello 1 P1 left uV device_power 2000", "source device_power instead of time_domain"),
        ("hello 1 P1 left uV time_domain 1000", "period 1000 instead of 2000"),
        ("hello 2 P1 left uV time_domain 2000", "protocol 2 instead of 1"),
    ],
)
def test_another_participant_side_or_signal_ends_the_session_before_it_begins(hello: str, what: str) -> None:
    link, one, end = ran([(0.0, Event.LINE, hello), *betas(range(8))], 20.0, hello=False)
    assert (end, one.detail) == (End.STRANGER, what)
    assert link.amplitudes == []
    assert link.sent[-1][1].startswith("end ")
    assert not any(followed(one))


@pytest.mark.hazard("H02")
def test_a_device_that_does_not_say_who_it_is_gets_cdbs_alone() -> None:
    link, one, _ = ran(betas(range(10)), 22.0, hello=False)
    assert not any(followed(one))
    assert {ma for _, ma in link.amplitudes} == {CDBS}


@pytest.mark.hazard("H11")
@pytest.mark.parametrize(
    ("coming", "why"),
    [
        ([(18.0, Event.LINE, beta_line(7))], "number 7 after number 7"),
        ([(18.0, Event.LINE, beta_line(7, seq=6))], "number 6 after number 7"),
        ([(18.0, Event.LINE, beta_line(8, seq=12))], "number 12 after number 7"),
        ([(18.0, Event.LINE, "beta 8 18000 1.0")], "a line that is no message"),
        ([(18.0, Event.LINE, "amplitude 3 3 3 policy -")], "a line that is no message"),
        ([(18.0, Event.LINE, "x" * 10_000)], "a line that is no message"),
        ([(16.5, Event.LOST, "")], "the device is gone"),
        ([(17.0, Event.LINE, HELLO), (18.0, Event.LINE, beta_line(8, seq=0))], "the device started anew"),
    ],
)
def test_a_duplicate_a_gap_a_restart_and_a_lost_link_give_cdbs_and_a_new_window(coming: list[tuple[float, Event, str]], why: str) -> None:
    rows: list[Row] = []
    link = ScriptedLink([(0.0, Event.LINE, HELLO), *betas(range(8)), *coming, (18.4, Event.STOP, "")])
    session(link, rows).run()
    returns_to_cdbs_within(link, coming[0][0], 1.0)
    assert any(why in row.decision.detail and row.decision.reasons & Reason.LINK for row in rows)


@pytest.mark.hazard("H11")
def test_a_device_that_comes_back_gets_the_network_after_a_whole_window_of_its_own() -> None:
    again = [(21.0 + PERIOD * k, Event.LINE, beta_line(k, sent_s=5.0 + PERIOD * k)) for k in range(6)]
    _, one, end = ran([*betas(range(8)), (16.5, Event.LOST, ""), (20.5, Event.LINE, HELLO), *again], 34.0)
    back = [d.t_s for d in one.decisions if not d.fallback and d.t_s > 16.5]
    assert back[0] == pytest.approx(25.0)
    assert end is End.INPUT_ENDED


@pytest.mark.hazard("H12")
@pytest.mark.parametrize("jump_s", [3600.0, -3600.0, 5.0, -5.0])
def test_a_jump_of_the_devices_clock_gives_cdbs_and_a_new_window(jump_s: float) -> None:
    jumped = [(PERIOD * (k + 1), Event.LINE, beta_line(k, sent_s=4000 + PERIOD * (k + 1) + jump_s)) for k in range(8, 14)]
    before = [(PERIOD * (k + 1), Event.LINE, beta_line(k, sent_s=4000 + PERIOD * (k + 1))) for k in range(8)]
    link, one, _ = ran([*before, *jumped], 30.0)
    returns_to_cdbs_within(link, 18.0, 0.5)
    assert any(followed(one)[10:]), "and the network is asked again once a window has come by the new clock"


@pytest.mark.hazard("H13")
def test_a_missed_deadline_gives_cdbs_and_what_waited_is_not_taken_for_the_present() -> None:
    link, one, _ = ran(betas(range(20)), 41.0, stalls={20: 4.5})
    woken = next(b for a, b in pairwise(one.decisions) if b.t_s - a.t_s > 4.0)
    assert woken.fallback
    assert woken.amplitude_ma == CDBS
    assert one.missed == 1
    assert any(not d.fallback for d in one.decisions if d.t_s > woken.t_s + W * PERIOD)
    gaps = [b - a for (a, _), (b, _) in pairwise(link.amplitudes)]
    assert min(gaps) >= 0.45 * PERIOD, "what was missed is not made up for in a burst"


@pytest.mark.hazard("H13")
def test_a_standstill_after_which_the_device_is_back_on_clinical_settings_ends_the_session() -> None:
    link, one, end = ran(betas(range(20)), 41.0, stalls={20: 7.0})
    assert end is End.STOOD_STILL
    assert one.decisions[-1].amplitude_ma == CDBS
    assert link.sent[-1][1].split()[0::4] == ["end", "stood_still"]


@pytest.mark.hazard("H14")
def test_a_flood_of_lines_gives_no_more_decisions_than_there_are_periods() -> None:
    flood = [(16.2 + 0.001 * k, Event.LINE, beta_line(8 + k, sent_s=16.2 + 0.001 * k)) for k in range(3000)]
    _, one, _ = ran([*betas(range(8)), *flood], 22.0)
    assert len(one.decisions) <= 8 + 2 * 3 + 2
    assert all(d.fallback for d in one.decisions if d.t_s > 17.3)
    garbage = [(16.2 + 0.001 * k, Event.LINE, "\x00\xff" * 40) for k in range(3000)]
    _, one, _ = ran([*betas(range(8)), *garbage], 22.0)
    assert len(one.decisions) <= 8 + 2 * 3 + 2
    assert all(d.fallback for d in one.decisions if d.t_s > 17.3)


@pytest.mark.hazard("H05")
@pytest.mark.hazard("H06")
def test_amplitudes_never_leave_the_limits_nor_move_faster_than_the_ramp_but_back_to_cdbs() -> None:
    odd = [(PERIOD * (k + 1) + (0.3 * (k % 3) if k % 7 else 2.5), Event.LINE, beta_line(k)) for k in range(200)]
    link, _, _ = ran(odd, 402.0)
    amplitudes = [ma for _, ma in link.amplitudes]
    assert len(set(amplitudes)) > 2
    assert all(LIMITS.min_ma <= ma <= LIMITS.max_ma for ma in amplitudes)
    for (_, a), (_, b) in pairwise(link.amplitudes):
        assert b == CDBS or abs(b - a) <= LIMITS.ramp_ma_per_s * PERIOD + 1e-6


@pytest.mark.hazard("H15")
def test_the_session_ends_by_itself_on_clinical_settings() -> None:
    link = ScriptedLink([(0.0, Event.LINE, HELLO), *betas(range(100))])
    rows: list[Row] = []
    one = session(link, rows, seconds=20.0)
    assert one.run() is End.COMPLETE
    took_over = next(d.t_s for d in one.decisions if not d.fallback)
    assert one.decisions[-1].t_s - took_over == pytest.approx(20.0)
    assert (rows[-1].ended, rows[-1].decision.amplitude_ma) == (End.COMPLETE, CDBS)
    assert rows[-1].sample is not None, "the last period has its beta"
    assert link.sent[-1][1] == f"end {len(link.amplitudes) + 1} {1000 * one.decisions[-1].t_s:.0f} 3 complete\n"


@pytest.mark.hazard("H15")
def test_a_session_whose_beta_never_comes_ends_too() -> None:
    link = ScriptedLink([(0.0, Event.LINE, HELLO)])
    one = session(link, seconds=20.0)
    assert one.run() is End.COMPLETE
    assert 318.0 <= one.decisions[-1].t_s <= 322.0


@pytest.mark.hazard("H15", "H24")
@pytest.mark.parametrize(("event", "text"), [(Event.STOP, ""), (Event.LINE, "stop")])
def test_a_stop_from_the_tablet_or_the_device_ends_it_at_once(event: Event, text: str) -> None:
    link, one, end = ran([*betas(range(8)), (16.9, event, text), *betas(range(8, 20))], 50.0)
    assert end is End.STOPPED
    assert link.sent[-1][0] == pytest.approx(16.9)
    assert one.decisions[-1].amplitude_ma == CDBS


@pytest.mark.hazard("H15")
def test_a_session_that_reaches_midnight_ends() -> None:
    link = ScriptedLink([(0.0, Event.LINE, HELLO), *betas(range(100))])
    one = session(link, seconds=600.0, over=lambda: link.now_s > 130.0)
    assert one.run() is End.EXPIRED
    assert one.decisions[-1].amplitude_ma == CDBS


@pytest.mark.hazard("H16")
def test_a_log_that_fails_a_device_that_is_gone_and_a_fault_of_our_own_end_on_clinical_settings() -> None:
    def full(row: Row) -> None:
        if row.due_s > 16:
            raise LogFailed("no space left")

    link = ScriptedLink([(0.0, Event.LINE, HELLO), *betas(range(20))])
    one = session(link)
    one.log = full
    assert one.run() is End.LOG_FAILED
    assert link.sent[-1][1].split()[0] == "end"
    gone = ScriptedLink([(0.0, Event.LINE, HELLO), *betas(range(20))], refuses_after=8)
    rows: list[Row] = []
    assert session(gone, rows).run() is End.DEVICE_GONE
    assert (rows[-1].ended, rows[-1].decision.amplitude_ma) == (End.DEVICE_GONE, CDBS)

    def broken(row: Row) -> None:
        if row.due_s > 16:
            raise ZeroDivisionError("ours")

    link = ScriptedLink([(0.0, Event.LINE, HELLO), *betas(range(20))])
    one = session(link)
    one.log = broken
    with pytest.raises(ZeroDivisionError):
        one.run()
    assert link.sent[-1][1].split()[0::4] == ["end", "fault"]


@pytest.mark.hazard("H08")
def test_a_network_that_fails_or_answers_nonsense_gives_cdbs() -> None:
    class Odd:
        def __init__(self) -> None:
            self.asked = 0

        def push(self, beta: float) -> None:
            pass

        def fraction(self) -> float:
            self.asked += 1
            if self.asked == 3:
                raise RuntimeError("weights are gone")
            return {4: math.nan, 5: 1.7, 6: -0.2}.get(self.asked, 0.2)

    link = ScriptedLink([(0.0, Event.LINE, HELLO), *betas(range(10)), (21.0, Event.STOP, "")])
    one = session(link, controller=BoundedController(Odd(), LIMITS, SIGNAL))
    one.run()
    assert followed(one)[2:9] == [True, True, False, False, False, False, True]
    assert "weights are gone" in one.decisions[4].detail


def device(link: ScriptedLink) -> DeviceSide:
    """Return the reference device side after every line of a runner that was killed then: nothing more comes."""
    one = DeviceSide("P1", "left", CDBS, 0.5, 3.2)
    for at, line in link.sent:
        if not line.startswith("end"):
            one.hear(line, at)
    return one


@pytest.mark.hazard("H16")
def test_the_device_side_goes_back_to_clinical_settings_after_two_missing_messages() -> None:
    link, _, _ = ran(betas(range(8)), 16.1)
    one, last = device(link), link.amplitudes[-1]
    assert one.look(last[0] + 1.9) == last[1] < CDBS
    assert one.look(last[0] + 2 * PERIOD) == last[1]
    assert one.look(last[0] + 2.5 * PERIOD + 0.01) == CDBS
    assert (one.why, one.over) == ("watchdog", True)
    one.hear("amplitude 99 99 1.0 policy -\n", last[0] + 6)
    assert one.look(last[0] + 6) == CDBS, "a runner that comes back starts a session of its own"


@pytest.mark.hazard("H16")
@pytest.mark.parametrize(
    "line", ["amplitude 8 17000 2.", "amplitude 8 17000 x policy -\n", "amplitude 2 17000 0.7 policy -\n", "\n", "ampl\n"]
)
def test_the_device_side_takes_no_line_that_is_cut_off_old_or_no_message(line: str) -> None:
    link, _, _ = ran(betas(range(8)), 16.1)
    one = device(link)
    before = one.look(17.0)
    one.hear(line, 17.0)
    assert one.look(17.0) == before
    assert one.look(16.0 + 2.5 * PERIOD + 0.01) == CDBS, "and the watchdog counts it as missing"


@pytest.mark.hazard("H05")
def test_the_device_side_leaves_its_own_limits_for_no_message() -> None:
    link, _, _ = ran(betas(range(8)), 16.1)
    one = device(link)
    one.hear("amplitude 50 17000 9.5 policy -\n", 17.0)
    assert (one.look(17.0), one.over) == (CDBS, True)
