"""Pages of errors say what to do and lose no entry."""

from __future__ import annotations

import re
from datetime import timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.accounts import service as accounts
from app.accounts.deps import COOKIE
from app.platform.database import now, transaction
from app.tables.accounts import Role, SignIn

SECOND = "another horse battery"


@pytest.mark.parametrize(
    ("method", "path", "status", "heading"),
    [
        ("GET", "/no/such/page", 404, "There is no such page"),
        ("GET", "/participants/NOBODY", 404, "There is no such page"),
        ("DELETE", "/accounts", 405, "This address takes no such request"),
        ("GET", "/sessions/none", 422, "Something in this request cannot be used"),
    ],
)
def test_a_page_of_an_error_says_what_to_do(browser: TestClient, method: str, path: str, status: int, heading: str) -> None:
    answer = browser.request(method, path)
    assert answer.status_code == status
    assert f"<h1>{heading}</h1>" in answer.text
    assert '<a href="/jobs"' in answer.text  # the way on of a signed-in user
    assert "Sign out" in answer.text


def test_a_page_names_what_is_wrong_with_an_address_in_words(browser: TestClient) -> None:
    page = browser.get("/sessions/none").text
    assert "The address has \u201cnone\u201d where a whole number belongs." in page
    assert "Open the page from a link" in page
    assert "path &gt;" not in page
    assert "integer" not in page
    assert "\u201cx\u201d cannot be taken for offset: a whole number belongs there." in browser.get("/audit?offset=x").text


def test_an_expired_sign_in_gives_back_every_entry_and_takes_it_after_signing_in(browser: TestClient, participant_code: str) -> None:
    entered = {"number": "2", "date": "2026-03-30", "note": "slept <badly> & late"}
    live = browser.cookies[COOKIE]
    browser.cookies.set(COOKIE, "ended")
    refused = browser.post("/participants/P1/visits", data=entered)
    assert refused.status_code == 401
    assert "Your sign-in has expired" in refused.text
    assert "<dd>slept &lt;badly&gt; &amp; late</dd>" in refused.text
    assert "Send it again" not in refused.text  # it is unknown who entered this
    assert "open the form anew" in refused.text
    browser.cookies.clear()
    browser.cookies.set(COOKIE, live)
    assert browser.post("/participants/P1/visits", data=entered).status_code == 303


def again(page: str) -> str:
    """Find where the page of an error sends what was entered."""
    return re.findall(r'<form method="post" action="([^"]*)"[^>]*data-again', page)[0]


def test_what_an_expired_sign_in_gives_back_is_sent_again_by_its_writer_alone(browser: TestClient, participant_code: str) -> None:
    entered = {"number": "2", "date": "2026-03-30", "note": "slept badly"}
    with transaction("test") as db:
        accounts.add_user(db, "second@clinic.example", Role.CLINICIAN, SECOND)
        first = db.scalars(select(SignIn)).one()
        first.last_seen_at = now() - timedelta(days=1)
    live = browser.cookies[COOKIE]
    refused = browser.post("/participants/P1/visits", data=entered)
    assert refused.status_code == 401
    assert '<input type="hidden" name="note" value="slept badly">' in refused.text
    target = again(refused.text)
    browser.cookies.clear()
    browser.post("/sign-in", data={"email": "second@clinic.example", "password": SECOND})
    assert browser.cookies[COOKIE] != live
    stopped = browser.post(target, data=entered)
    assert stopped.status_code == 409
    assert "Another person had signed in when this was entered" in stopped.text
    assert "slept badly" not in stopped.text
    assert "2026-03-30" not in browser.get("/participants/P1").text
    with transaction("test") as db:
        db.get_one(SignIn, first.id).last_seen_at = now()
    browser.cookies.clear()
    browser.cookies.set(COOKIE, live)
    assert browser.post(target, data=entered).status_code == 303
    assert "2026-03-30" in browser.get("/participants/P1").text


def test_what_another_error_gives_back_is_its_writers_too(browser: TestClient) -> None:
    refused = browser.post("/participants/NOBODY/visits", data={"number": "2"})
    assert refused.status_code == 404
    assert "NOBODY" in re.findall(r"(?s)<main.*?<section", refused.text)[0]  # a rule of ours says what is not there
    assert re.fullmatch(r"/participants/NOBODY/visits\?written_by=\d+", again(refused.text))


def test_what_is_sent_again_goes_to_the_whole_address_of_its_form_and_to_no_other_host(browser: TestClient) -> None:
    refused = browser.post("/participants/NOBODY/visits?from=day&written_by=1&of=a%26b", data={"number": "2"})
    assert re.fullmatch(r"/participants/NOBODY/visits\?from=day&amp;of=a%26b&amp;written_by=\d+", again(refused.text))
    for elsewhere in ("//evil.example/visits", "/\\evil.example/visits"):
        refused = browser.post(f"http://testserver{elsewhere}?written_by=1", data={"number": "2"})
        assert refused.status_code == 404
        assert re.match(r"/(evil|%5Cevil)", again(refused.text))


def test_a_password_is_not_given_back(browser: TestClient) -> None:
    browser.cookies.set(COOKIE, "ended")
    refused = browser.post("/account/password", data={"present_password": "old secret 123", "new_password": "new secret 123"})
    assert refused.status_code == 401
    assert "secret" not in refused.text


def test_a_form_that_is_too_large_is_refused_on_a_page(browser: TestClient, participant_code: str) -> None:
    refused = browser.post("/participants/P1/visits", data={"note": "x" * (2 << 20)})
    assert refused.status_code == 413
    assert refused.headers["content-type"].startswith("text/html")
    assert refused.headers["connection"] == "close"
    assert "<h1>Too large to take</h1>" in refused.text


def test_programs_get_a_problem_document_as_before(client: TestClient) -> None:
    refused = client.post("/api/v1/participants", content=b"x" * (2 << 20), headers={"Content-Type": "application/json"})
    assert refused.status_code == 413
    assert refused.headers["content-type"] == "application/problem+json"
    assert refused.json()["title"] == "The request is too large"
