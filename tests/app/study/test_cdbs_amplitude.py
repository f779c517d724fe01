"""One rule for the cDBS amplitude in force, of a session as of the next bundle."""

from __future__ import annotations

from datetime import date
from html import unescape

import pytest
from fastapi.testclient import TestClient

from app.platform.errors import Invalid
from app.study import cdbs_amplitude
from app.tables.participants import Hemisphere, Participant, SettingsVersion
from app.tables.visits import CdbsAmplitude, Visit
from tests.app.words import flat

LEFT, RIGHT = Hemisphere.LEFT, Hemisphere.RIGHT


def visit(number: int, *stated: tuple[Hemisphere, int, float], day: date | None = None) -> Visit:
    return Visit(number=number, date=day, cdbs_amplitudes=[CdbsAmplitude(hemisphere=h, program=p, amplitude_ma=ma) for h, p, ma in stated])


def settings(cdbs: float | None = 2.0) -> SettingsVersion:
    return SettingsVersion(cdbs_amplitude_ma=cdbs)


def test_a_visits_amplitude_of_the_side_and_program_is_in_force_else_that_of_program_0_else_the_settings() -> None:
    day = visit(1, (LEFT, 0, 3.0), (LEFT, 2, 1.5), (RIGHT, 0, 2.5))
    assert [cdbs_amplitude.in_force(day, LEFT, settings(), p) for p in (0, 1, 2)] == [3.0, 3.0, 1.5]
    assert cdbs_amplitude.in_force(day, RIGHT, settings(), 2) == 2.5
    assert cdbs_amplitude.in_force(visit(1, (LEFT, 0, 3.0)), RIGHT, settings()) == 2.0
    assert cdbs_amplitude.in_force(visit(1, (LEFT, 1, 3.0)), LEFT, settings()) == 2.0
    assert cdbs_amplitude.in_force(visit(1), None, settings(None)) is None


def test_two_sides_need_a_name_even_where_they_agree() -> None:
    for right in (2.5, 3.0):
        with pytest.raises(Invalid, match="visit 4 has cDBS amplitudes for both"):
            cdbs_amplitude.in_force(visit(4, (LEFT, 0, 3.0), (RIGHT, 0, right)), None, settings())


def test_the_newest_visit_that_states_the_side_is_in_force_now() -> None:
    person = Participant(settings=[settings()], visits=[visit(2, (LEFT, 0, 3.0)), visit(3, (RIGHT, 0, 2.5)), visit(1, (LEFT, 0, 9.0))])
    assert cdbs_amplitude.in_force_now(person, LEFT) == 3.0
    assert cdbs_amplitude.in_force_now(person, None) == 2.5


def test_an_earlier_day_that_was_entered_late_is_not_the_newest_visit() -> None:
    march, april = date(2026, 3, 2), date(2026, 4, 6)
    late = visit(3, (LEFT, 0, 4.0), day=march)
    person = Participant(settings=[settings()], visits=[visit(1), visit(2, (LEFT, 0, 3.0), day=april), late])
    assert cdbs_amplitude.in_force_now(person, LEFT) == 3.0
    person.visits.append(visit(4, (LEFT, 0, 2.5)))
    assert cdbs_amplitude.in_force_now(person, LEFT) == 2.5, "one without a date stands where its number puts it"


def test_without_a_visit_that_states_one_the_settings_are_in_force_now() -> None:
    assert cdbs_amplitude.in_force_now(Participant(settings=[settings()], visits=[visit(1)]), LEFT) == 2.0
    with pytest.raises(Invalid, match="not known"):
        cdbs_amplitude.in_force_now(Participant(settings=[settings(None)], visits=[]), LEFT)


def test_of_several_programs_the_next_bundle_takes_program_0_else_the_only_amplitude() -> None:
    def now(*stated: tuple[Hemisphere, int, float]) -> float:
        return cdbs_amplitude.in_force_now(Participant(settings=[settings()], visits=[visit(1, *stated)]), LEFT)

    assert now((LEFT, 0, 3.0), (LEFT, 1, 1.5)) == 3.0
    assert now((LEFT, 1, 1.5)) == 1.5
    with pytest.raises(Invalid, match="several programs"):
        now((LEFT, 1, 1.5), (LEFT, 2, 1.0))


@pytest.mark.parametrize(
    ("day", "side", "program", "words"),
    [
        (visit(3), LEFT, 0, "nobody has stated the cDBS amplitude"),
        (
            visit(3, (LEFT, 0, 3.0)),
            RIGHT,
            0,
            "visit 3 states the cDBS amplitude of left, program 0, and none of the right hemisphere, program 0",
        ),
        (
            visit(3, (LEFT, 1, 3.0)),
            LEFT,
            2,
            "visit 3 states the cDBS amplitude of left, program 1, and none of the left hemisphere, program 2",
        ),
    ],
)
def test_an_amplitude_that_is_not_in_force_is_missed_by_its_side_and_program(
    day: Visit, side: Hemisphere, program: int, words: str
) -> None:
    assert cdbs_amplitude.in_force(day, side, settings(None), program) is None
    assert cdbs_amplitude.lacking(day, side, settings(None), program) == words


OF_ONE_SIDE = "visit 2 states the cDBS amplitude of left, program 0, and none of the right hemisphere, program 0"


def test_no_page_says_that_nobody_stated_an_amplitude_where_the_other_side_has_one(client: TestClient) -> None:
    draft = {"code": "P1", "settings": {"xi_beta": 1.2, "beta_unit": "uV", "beta_source": "table"}}
    assert client.post("/api/v1/participants", json=draft).status_code == 201
    stated = {"number": 2, "cdbs_amplitudes": [{"hemisphere": "left", "amplitude_ma": 3.0}]}
    visit_id = client.post("/api/v1/participants/P1/visits", json=stated).json()["id"]
    rows = "t_s,beta,amplitude_ma\n" + "".join(f"{2 * k},1,{1 + k % 2}\n" for k in range(-9, 31))
    for controller in ("random", ""):
        fields = {"participant": "P1", "visit": "2", "controller": controller, "hemisphere": "right"}
        sent = client.post("/api/v1/uploads", data={n: v for n, v in fields.items() if v}, files={"file": (f"{controller}.csv", rows)})
        assert sent.status_code == 201, sent.text
        rows = rows.replace(",2\n", ",2.1\n")
    pages = ["/participants/P1/proposals", f"/visits/{visit_id}", "/participants/P1/analyses", "/participants/P1/policies"]
    (session,) = client.get(f"/api/v1/visits/{visit_id}/sessions").json()["items"]
    texts = {p: unescape(flat(client.get(p, headers={"Accept": "text/html"}).text)) for p in (*pages, f"/sessions/{session['id']}")}
    refused = client.post("/api/v1/participants/P1/snapshots")
    texts["snapshot"] = refused.text
    assert [where for where, text in texts.items() if "nobody has stated the cDBS" in text or "cDBS amplitude is not stated" in text] == []
    assert OF_ONE_SIDE in texts["/participants/P1/proposals"], texts["/participants/P1/proposals"][-3000:]
    assert "not stated for its side and program" in texts[f"/sessions/{session['id']}"]
