"""Enrolment: a code that may reveal a person is questioned, and the form asks for what a coordinator knows."""

from __future__ import annotations

import re
from datetime import date

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, text
from sqlalchemy.exc import IntegrityError

from app.platform.database import new_session
from app.study.participation import CodeQuestion, questions
from app.tables.audit import AuditEvent

TODAY = date(2026, 11, 22)
NAME, YEAR, DATE = CodeQuestion.NAME, CodeQuestion.BIRTH_YEAR, CodeQuestion.BIRTH_DATE


def test_synthetic_is_stated_at_enrolment_and_never_changed(client: TestClient) -> None:
    for code, stated in (("S1", {"synthetic": True}), ("R1", {})):
        made = client.post("/api/v1/participants", json={"code": code, **stated})
        assert (made.status_code, made.json()["synthetic"]) == (201, bool(stated))
    for change in ({"synthetic": False, "status": "active", "reason": "x"},):
        assert client.patch("/api/v1/participants/S1", json=change).status_code == 422
    form = {"code": "S2", "synthetic": "yes"}
    assert client.post("/participants", data=form, follow_redirects=False).status_code == 303
    assert client.get("/api/v1/participants/S2").json()["synthetic"] is True
    for code, value in (("S1", "false"), ("R1", "true")):
        with new_session() as db, pytest.raises(IntegrityError, match="never changed"):
            db.execute(text(f"update participant set synthetic = {value} where code = '{code}'"))


@pytest.mark.parametrize(
    ("code", "asked"),
    [
        ("P1", ()),
        ("SITE-01", ()),
        ("Patient_7", ()),
        ("STN-0042", ()),
        ("2026-01", ()),  # no participant was born this year
        ("P-1850", ()),
        ("20261122", ()),
        ("JSmith-1961", (NAME, YEAR)),
        ("anna", (NAME,)),
        ("LEVI-2", (NAME,)),
        ("Lee", (NAME,)),
        ("P1961", (YEAR,)),
        ("P_19610412", (DATE,)),
        ("12041961", (DATE,)),
        ("12-04-1961", (YEAR, DATE)),
        ("P-99999999", ()),
    ],
)
def test_a_code_is_asked_about_where_it_may_tell_who_somebody_is(code: str, asked: tuple[CodeQuestion, ...]) -> None:
    assert questions(code, TODAY) == asked


def test_the_interface_asks_with_a_typed_problem_and_takes_the_answer(client: TestClient) -> None:
    refused = client.post("/api/v1/participants", json={"code": "JSmith-1961"})
    assert refused.status_code == 422
    assert [q["code"] for q in refused.json()["questions"]] == ["name", "birth_year"]
    assert client.get("/api/v1/participants/JSmith-1961").status_code == 404
    taken = client.post("/api/v1/participants", json={"code": "JSmith-1961", "is_study_code": True})
    assert taken.status_code == 201
    with new_session() as db:
        kept = db.scalars(select(AuditEvent.reason).where(AuditEvent.entity == "participant", AuditEvent.reason.is_not(None))).all()
    assert kept == ["looked at by a person: a study code"]


def test_the_threshold_of_the_data_is_taken_with_the_source_of_its_beta(client: TestClient) -> None:
    client.post("/api/v1/participants", json={"code": "P2", "settings": {"beta_unit": "uV", "cdbs_amplitude_ma": 3.0}})
    client.post("/api/v1/participants/P2/visits", json={"number": 1})
    rows = "".join(f"{2 * k},{1 + k % 2},1\n" for k in range(21))
    sent = {"participant": "P2", "visit": "1", "controller": "cdbs"}
    table = f"t_s,beta,amplitude_fraction\n{rows}".encode()
    answer = client.post("/api/v1/uploads", data=sent, files={"file": ("s.csv", table)})
    assert answer.status_code == 201, answer.text
    page = client.get("/participants/P2/settings").text
    offer = page.split("From the data")[1].split("</form>")[0]
    client.post("/participants/P2/settings", data=dict(re.findall(r'name="(\w+)" value="([^"]*)"', offer)))
    taken = client.get("/api/v1/participants/P2").json()["settings"]
    assert (taken["beta_unit"], taken["beta_source"]) == ("uV", "table")
    assert 1 <= taken["xi_beta"] <= 2


def test_the_form_asks_for_the_code_and_leaves_the_constants_in_a_fold(client: TestClient) -> None:
    page = client.get("/participants/new").text
    before, fold = page.split("<details")[0], page.split("<details")[1]
    assert set(re.findall(r'<input id="f-(\w+)"', before)) == {"code", "cdbs_amplitude_ma"}
    assert 'id="f-gamma"' in fold
    assert "is_study_code" not in page
    asked = client.post("/participants", follow_redirects=False, data={"code": "JSmith-1961", "cdbs_amplitude_ma": "3"})
    assert asked.status_code == 422
    assert 'name="is_study_code"' in asked.text
    assert "a year in which a participant may have been born" in asked.text
    assert 'value="JSmith-1961"' in asked.text
    done = client.post(
        "/participants", follow_redirects=False, data={"code": "JSmith-1961", "cdbs_amplitude_ma": "3", "is_study_code": "yes"}
    )
    assert done.headers["location"] == "/participants/JSmith-1961?done=enrolled"
    assert client.get("/api/v1/participants/JSmith-1961").json()["settings"]["cdbs_amplitude_ma"] == 3.0
