"""Values outside the usual are asked about at their field, and kept where a person says that they are right."""

from __future__ import annotations

from html import unescape
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.study import outcome_fields
from app.study.outcome_fields import Question, Why, question
from tests.app.pages.conftest import browser, password_hash, sign_in  # noqa: F401
from tests.app.pages.test_stale_forms import Tab


def asked(answer: Any) -> list[tuple[str, str, bool]]:
    assert answer.status_code == 422, answer.text
    return [(q["field"], q["code"], q["confirmed"]) for q in answer.json()["questions"]]


@pytest.mark.parametrize(
    ("name", "value", "code"),
    [
        ("grasp_hz", 6.0, None),
        ("grasp_hz", 6.1, Why.ABOVE),
        ("grasp_hz", 0.2, Why.BELOW),
        ("tremor_percent", 0.0, None),
        ("tremor_percent", 0.25, Why.SHARE),
        ("tremor_percent", 1.0, None),
        ("tremor_percent", 96.0, Why.ABOVE),
        ("cdbs_amplitude_ma", 6.0, None),
        ("cdbs_amplitude_ma", 30.0, Why.ABOVE),
        ("cdbs_amplitude_ma", 0.3, Why.BELOW),
        ("grasp_hz", None, None),
    ],
)
def test_what_is_usual_is_not_asked_about(name: str, value: float | None, code: Why | None) -> None:
    found = question(name, value)
    assert (found.code if found else None) == code


@pytest.mark.parametrize(
    ("rating", "others", "is_asked"),
    [(2, [8, 7, 9], True), (2, [8, 6, 9], False), (2, [8, 9], False), (9, [3, 4, 1], True), (5, [], False)],
)
def test_a_rating_is_asked_about_where_it_is_far_from_every_other_one_of_its_visit(
    rating: int, others: list[float], is_asked: bool
) -> None:
    assert (question("rating", rating, others) is not None) is is_asked


def test_every_question_has_its_sentence_and_no_decision_rests_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for code in Why:
        assert "?" in outcome_fields.unusual(Question("grasp_hz", code, 0.5, "Hz", 0.3, 6))
    monkeypatch.setattr(outcome_fields, "unusual", lambda q: "other words")
    found = question("grasp_hz", 7)
    assert found is not None
    assert found.code is Why.ABOVE


def test_the_interface_asks_and_takes_a_persons_word(client: TestClient, upload: Any) -> None:
    url = f"/api/v1/sessions/{upload('cdbs', qoc={})}/qoc"
    both = {"grasp_hz": 7.2, "tremor_percent": 0.3, "rating": 7}
    refused = client.put(url, json=both | {"sure": []})
    assert asked(refused) == [("grasp_hz", "above_usual", False), ("tremor_percent", "share_not_percent", False)]
    first = refused.json()["questions"][0]
    assert (first["value"], first["low"], first["high"], first["unit"]) == (7.2, 0.3, 6.0, "Hz")
    assert client.get(url).json() is None
    assert asked(client.put(url, json=both | {"sure": ["grasp_hz"]})) == [
        ("grasp_hz", "above_usual", True), ("tremor_percent", "share_not_percent", False),
    ]  # fmt: skip
    assert client.put(url, json=both | {"sure": ["grasp_hz", "tremor_percent"]}).status_code == 200
    # a stored value is not asked about again when another value is corrected
    assert client.put(url, json={"grasp_hz": 7.2, "rating": 6, "sure": []}).json()["rating"] == 6


def test_a_program_that_can_ask_nobody_is_not_asked(client: TestClient, participant_code: str, upload: Any) -> None:
    unusual = {"grasp_hz": 7.2, "tremor_percent": 0.3}
    assert client.put(f"/api/v1/sessions/{upload('cdbs', qoc={})}/qoc", json=unusual).status_code == 200
    high = [{"hemisphere": "left", "amplitude_ma": 8.0}]
    assert client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 2, "cdbs_amplitudes": high}).status_code == 201
    assert client.put(f"/api/v1/participants/{participant_code}/settings", json={"settings": {"cdbs_amplitude_ma": 9}}).status_code == 200
    assert client.post("/api/v1/participants", json={"code": "P7", "settings": {"cdbs_amplitude_ma": 9}}).status_code == 201


def test_a_rating_is_held_against_the_newest_ones_of_its_visit(client: TestClient, upload: Any) -> None:
    others = [upload("random", qoc={"rating": r}) for r in (8, 9, 3)]
    url = f"/api/v1/sessions/{upload('cdbs', qoc={})}/qoc"
    assert client.put(url, json={"rating": 2, "sure": []}).status_code == 200
    assert client.put(f"/api/v1/sessions/{others[2]}/qoc", json={"rating": 8, "reason": "read upside down"}).status_code == 200
    assert asked(client.put(url, json={"rating": 1, "sure": []})) == [("rating", "far_from_visit", False)]


def test_amplitudes_of_visits_settings_and_enrolments_are_asked_about(client: TestClient, participant_code: str) -> None:
    visits = f"/api/v1/participants/{participant_code}/visits"
    high = {"hemisphere": "left", "amplitude_ma": 8.0, "sure": False}
    refused = client.post(visits, json={"number": 2, "cdbs_amplitudes": [high]})
    assert asked(refused) == [("cdbs_amplitudes", "above_usual", False)]
    assert (refused.json()["questions"][0]["hemisphere"], refused.json()["questions"][0]["program"]) == ("left", 0)
    made = client.post(visits, json={"number": 2, "cdbs_amplitudes": [high | {"sure": True}]})
    assert made.status_code == 201, made.text
    visit = f"/api/v1/visits/{made.json()['id']}"
    # the standing amplitude is not asked about with a new one
    two = [high, {"hemisphere": "right", "amplitude_ma": 2.5}]
    assert client.patch(visit, json={"cdbs_amplitudes": two, "reason": "both sides"}).status_code == 200
    settings = {"settings": {"cdbs_amplitude_ma": 0.2}, "sure": []}
    assert asked(client.put(f"/api/v1/participants/{participant_code}/settings", json=settings)) == [
        ("cdbs_amplitude_ma", "below_usual", False)
    ]
    assert (
        client.put(f"/api/v1/participants/{participant_code}/settings", json=settings | {"sure": ["cdbs_amplitude_ma"]}).status_code == 200
    )
    new = {"code": "P7", "settings": {"cdbs_amplitude_ma": 9}, "sure": []}
    assert asked(client.post("/api/v1/participants", json=new)) == [("cdbs_amplitude_ma", "above_usual", False)]
    assert client.post("/api/v1/participants", json=new | {"sure": ["cdbs_amplitude_ma"]}).status_code == 201


def test_the_page_asks_at_the_field_and_a_tick_answers_for_what_was_typed(client: TestClient, browser: TestClient, upload: Any) -> None:  # noqa: F811
    session = upload("cdbs", qoc={})
    tab = Tab(browser, f"/sessions/{session}", f"/sessions/{session}/qoc")
    refused = tab.send(grasp_hz="7,2", rating="6")
    page = unescape(refused.text)
    assert refused.status_code == 422
    assert "7.2 Hz is above what is usual (0.3 to 6 Hz). Is it right?" in page
    assert 'value="7,2"' in page
    assert '<input type="checkbox" name="sure" value="grasp_hz=7,2">' in page
    # a tick for another number than the typed one answers nothing
    assert tab.send(grasp_hz="8", rating="6", sure="grasp_hz=7,2").status_code == 422
    assert tab.send(grasp_hz="7,2", rating="6", sure="grasp_hz=7,2").status_code == 303
    assert client.get(f"/api/v1/sessions/{session}/qoc").json()["grasp_hz"] == 7.2


def test_a_field_that_cannot_be_used_says_so_beside_itself(browser: TestClient, upload: Any) -> None:  # noqa: F811
    session = upload("cdbs", qoc={})
    tab = Tab(browser, f"/sessions/{session}", f"/sessions/{session}/qoc")
    page = unescape(tab.send(grasp_hz="25", rating="seven").text)
    assert "'seven' is no whole number" in page.split('id="n-rating"')[1][:80]
    assert page.count('aria-invalid="true"') == 1


def test_the_pages_of_visits_settings_and_enrolment_ask_too(browser: TestClient, client: TestClient, participant_code: str) -> None:  # noqa: F811
    new = {"number": "2", "date": "2026-04-01", "note": "lay down", "cdbs_left": "8"}
    page = unescape(browser.post(f"/participants/{participant_code}/visits", data=new).text)
    assert '<input type="checkbox" name="sure" value="cdbs_left=8">' in page
    assert "lay down" in page
    made = browser.post(f"/participants/{participant_code}/visits", data=new | {"sure": "cdbs_left=8"})
    assert made.status_code == 303
    url = made.headers["location"].split("?")[0]
    tab = Tab(browser, url, url)
    assert 'value="cdbs_right_1=7.5"' in tab.send(cdbs_right_1="7.5", reason="read again").text
    assert tab.send(cdbs_right_1="7.5", reason="read again", sure="cdbs_right_1=7.5").status_code == 303
    settings = Tab(browser, f"/participants/{participant_code}/settings", f"/participants/{participant_code}/settings")
    assert 'value="cdbs_amplitude_ma=9"' in settings.send(cdbs_amplitude_ma="9").text
    assert settings.send(cdbs_amplitude_ma="9", sure="cdbs_amplitude_ma=9").status_code == 303
    enrol = {"code": "P8", "cdbs_amplitude_ma": "9"}
    assert 'value="cdbs_amplitude_ma=9"' in browser.post("/participants", data=enrol).text
    assert browser.post("/participants", data=enrol | {"sure": "cdbs_amplitude_ma=9"}).status_code == 303
    assert client.get("/api/v1/participants/P8").json()["settings"]["cdbs_amplitude_ma"] == 9


def test_a_blinded_assessor_is_asked_too_and_keeps_what_was_typed(client: TestClient, upload: Any, client_as: Any) -> None:
    session, other = upload("cdbs", qoc={}), upload("rl", qoc={})
    visit = client.get(f"/api/v1/sessions/{session}").json()["visit_id"]
    blinded = client_as("blinded_assessor")
    html = {"Accept": "text/html"}
    answer = blinded.post(f"/sessions/{session}/qoc", data={"revision": "0", "grasp_hz": "7", "rating": "6"}, headers=html)
    page = unescape(answer.text)
    assert answer.status_code == 422
    assert page.count('name="sure"') == 1
    assert f'id="f-rating-{session}" name="rating" type="text" value="6"' in page
    assert f'id="f-rating-{other}" name="rating" type="text" value=""' in page
    assert "cDBS" not in page.split("<main")[1]
    done = blinded.post(
        f"/sessions/{session}/qoc", data={"revision": "0", "grasp_hz": "7", "rating": "6", "sure": "grasp_hz=7"}, follow_redirects=False
    )
    assert done.headers["location"] == f"/visits/{visit}?done=qoc"
