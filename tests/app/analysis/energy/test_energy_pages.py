"""Energy of stimulation by every measure; a battery's days under stated assumptions."""

from __future__ import annotations

import csv
import html
import io
import re
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.analysis.energy import Measure, Pulses, pulses_of, taken
from app.analysis.facts import Facts, Side
from app.study.blinding import Arm
from app.tables.recordings import Recording, Trace
from app.tables.sessions import Controller, SessionSegment

PATH = "/api/v1/participants/P1/analyses/energy"


def logged(db: Session, width_us: float, rate_hz: float) -> None:
    """Write the pulses of every recording, from its start on."""
    state = {"rate_hz": rate_hz, "programs": [{"program": 0, "amplitude_ma": 3.0, "pulse_width_us": width_us}]}
    for recording in db.scalars(select(Recording)):
        recording.details = {"events": [{"t_s": 0.0, "kind": "stimulation", "label": "", "data": state}, {"t_s": 1.0, "kind": "note"}]}
    db.commit()


def rows(answer: dict[str, Any], measure: str) -> dict[str, dict[str, Any]]:
    return {r["controller"]: r for r in answer["rows"] if r["measure"] == measure}


def test_charge_and_delivered_energy_follow_from_the_logged_pulses(
    client: TestClient, db: Session, add_session: Callable[..., int]
) -> None:
    add_session("cdbs", fraction=1.0)
    add_session("rl", fraction=0.5)
    logged(db, 60.0, 130.0)
    answer = client.get(f"{PATH}?impedance_ohm=1000").json()
    charge, teed = rows(answer, "charge_uc_per_s"), rows(answer, "teed_uw")
    # 3 mA * 60 us * 130 Hz = 23.4 uC/s; (3 mA)^2 * 1000 ohm * 60 us * 130 Hz = 70.2 uW
    assert charge["cdbs"]["mean"] == pytest.approx(23.4, rel=1e-5)
    assert charge["rl"]["mean"] == pytest.approx(11.7, rel=1e-5)
    assert teed["cdbs"]["mean"] == pytest.approx(70.2, rel=1e-5)
    assert teed["rl"]["saved_percent"] == pytest.approx(75.0, rel=1e-5)
    assert "I²" in teed["rl"]["definition"]
    assert not rows(client.get(PATH).json(), "teed_uw")
    assert rows(answer, "mean_a")["rl"]["mean"] == pytest.approx(0.5)
    assert rows(answer, "mean_a2")["rl"]["mean"] == pytest.approx(0.25)


def test_without_logged_pulses_there_is_no_charge_and_the_page_says_so(client: TestClient, add_session: Callable[..., int]) -> None:
    add_session("cdbs")
    answer = client.get(PATH).json()
    assert rows(answer, "charge_uc_per_s")["cdbs"]["mean"] is None
    assert answer["unknown_sides"] == 1
    page = client.get("/participants/P1/analyses/energy").text
    assert "have no recorded pulse width, rate or amplitude in mA" in page


def facts(*sides: Side) -> Facts:
    now = datetime(2026, 3, 2, tzinfo=UTC)
    return Facts(1, 1, 1, 1, Arm(Controller.RL, None), None, None, now, 300.0, {}, {}, None, None, sides, None, None)


def test_all_sides_and_programs_count_by_their_pulses() -> None:
    left = Side("left", 1, 0, True, 0.5, 0.25, 1.0, 1.0, 2.0)
    right = Side("right", 2, 0, False, 1.0, 1.0, 3.0, 9.0, 3.0)
    pulses = {(1, 0): Pulses(60.0, 130.0), (2, 0): Pulses(60.0, 65.0)}
    found = taken(facts(left, right), pulses, None).values
    assert found[Measure.ALL_SIDES] == pytest.approx((2 * 1 + 9) / (2 * 4 + 9))
    assert found[Measure.CHARGE] == pytest.approx((1e-3 * 130 + 3e-3 * 65) * 60)
    silent = replace(right, fraction=0.0, square=0.0, milliamperes=0.0, square_ma2=0.0)
    assert taken(facts(left, silent), pulses, None).values[Measure.ALL_SIDES] == pytest.approx(2 * 1 / (2 * 4 + 9))
    assert Measure.ALL_SIDES not in taken(facts(left, silent), {(1, 0): Pulses(60.0, 130.0)}, None).values
    assert taken(facts(replace(silent, name="left"), silent), {}, None).values[Measure.ALL_SIDES] == 0.0
    partly = taken(facts(left, right), {(1, 0): Pulses(60.0, 130.0)}, 1000.0)
    assert (partly.values, partly.unknown_sides) == ({}, 1)


def test_pulses_that_change_within_a_session_are_not_known() -> None:
    def event(t_s: float, width: float) -> dict[str, Any]:
        return {"t_s": t_s, "data": {"rate_hz": 130.0, "programs": [{"program": 0, "pulse_width_us": width}]}}

    events = [event(0, 60), event(100, 90), event(500, 60)]
    assert pulses_of(events, 0, 10, 90) == Pulses(60.0, 130.0)
    assert pulses_of(events, 0, 150, 400) == Pulses(90.0, 130.0)
    assert pulses_of(events, 0, 50, 400) == Pulses(None, 130.0)
    assert pulses_of(events, 1, 10, 90) == Pulses(None, None)


ASSUMED = {
    "capacity_low_mah": "100", "capacity_high_mah": "120", "voltage_v": "3.7", "other_drain_uw": "200", "impedance_ohm": "1000",
    "supply_v": "6", "pulse_width_us": "60", "rate_hz": "130", "cdbs_ma": "3", "source": "the manual",
}  # fmt: skip


def test_a_battery_lasts_longer_with_less_and_the_answer_is_a_range(client: TestClient, add_session: Callable[..., int]) -> None:
    add_session("cdbs")
    add_session("rl", fraction=0.5)
    page = client.get("/participants/P1/analyses/energy", params=ASSUMED)
    assert page.status_code == 200
    assert "Assumed: the manual" in page.text
    # cDBS: 100 mAh * 3.7 V over 3 mA * 6 V * 60 us * 130 Hz + 200 uW, to 120 mAh over I^2 R + 200 uW
    low, high = 100 * 3.7e3 / (140.4 + 200) / 24, 120 * 3.7e3 / (70.2 + 200) / 24
    assert f"{low:.1f}" in page.text
    assert f"{high:.1f}" in page.text
    api = "/api/v1/participants/P1/analyses/battery"
    cdbs, rl = client.get(api, params=ASSUMED).json()["rows"]
    assert (cdbs["days_low"], cdbs["days_high"]) == pytest.approx((low, high))
    assert rl["days_low"] > cdbs["days_low"]
    assert all(f"/sessions/{i}" in page.text for i in cdbs["session_ids"] + rl["session_ids"])
    linked = re.search(r'href="([^"]*battery[^"]*format=csv)"', page.text)
    assert linked
    table = list(csv.DictReader(io.StringIO(client.get(html.unescape(linked[1])).text)))
    assert [float(r["days_high"]) for r in table] == pytest.approx([cdbs["days_high"], rl["days_high"]])
    assert table[0]["source"] == ASSUMED["source"]
    assert client.get(api, params=ASSUMED | {"capacity_low_mah": "500"}).status_code == 422
    assert client.get(api, params=ASSUMED | {"rate_hz": "nan"}).status_code == 422
    wrong = client.get("/participants/P1/analyses/energy", params=ASSUMED | {"capacity_low_mah": "500"})
    assert wrong.status_code == 422
    assert "Give the smaller capacity first" in wrong.text


def test_a_battery_from_which_nothing_draws_is_said_to_have_no_life(client: TestClient, add_session: Callable[..., int]) -> None:
    add_session("cdbs")
    add_session("no_dbs", fraction=0.0)
    page = client.get("/participants/P1/analyses/energy", params=ASSUMED | {"other_drain_uw": "0"})
    assert page.status_code == 422
    assert "a battery from which nothing draws has no life to state" in page.text
    assert "State all other drain of the implant, above 0." in page.text


def test_a_side_that_cannot_be_read_leaves_no_sum_over_sides(client: TestClient, db: Session, add_session: Callable[..., int]) -> None:
    add_session("cdbs")
    session = add_session("rl", fraction=0.5)
    other = add_session("cdbs", visit=2)
    logged(db, 60.0, 130.0)
    recording = db.scalars(select(SessionSegment.recording_id).where(SessionSegment.session_id == other)).one()
    db.add(SessionSegment(session_id=session, recording_id=recording, start_s=0.0, stop_s=300.0, is_control=False))
    for trace in db.scalars(select(Trace).where(Trace.recording_id == recording)):
        trace.dt_s = 1.0
    db.commit()
    answer = client.get(PATH).json()
    assert rows(answer, "mean_a")["rl"]["mean"] == pytest.approx(0.5)
    assert rows(answer, "charge_uc_per_s")["rl"]["mean"] is None
    assert rows(answer, "all_sides_a2")["rl"]["mean"] is None
    assert answer["unknown_sides"] >= 1


def test_the_table_has_the_definition_beside_the_number(client: TestClient, add_session: Callable[..., int]) -> None:
    add_session("cdbs")
    assert "Mean over the session's steps of a²" in client.get("/participants/P1/analyses/energy.csv").text


def test_what_the_stimulator_told_of_its_battery_stands_apart_from_assumed_days(
    client: TestClient, db: Session, add_session: Callable[..., int]
) -> None:
    path = "/participants/P1/analyses/energy"
    add_session("cdbs", fraction=1.0)
    add_session("rl", fraction=0.5)
    page = client.get(path).text
    assert "Battery, measured" not in page, "nothing told it"
    assert "Battery, assumed" in page
    first, second = db.scalars(select(Recording).order_by(Recording.id)).all()
    first.details = {"settings": {"battery": {"percent": 73.0, "voltage_v": 2.415}}}
    second.details = {"settings": {"battery": {"percent": 88.0, "months_left": 31.0, "status": "OK"}}}
    db.commit()
    page = client.get(path).text
    measured = page.split("Battery, measured")[1]
    assert "n = 2" in measured
    assert [word in measured for word in ("73", "2.415", "88", "31")] == [True] * 4
    assert measured.count("—") >= 2, "what a device does not tell is not made up"
