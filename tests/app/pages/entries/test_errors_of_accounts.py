"""The forms of accounts and signatures say at each field what is wrong with it, and every template with such a form does."""

from __future__ import annotations

import re
from pathlib import Path

from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.tables.accounts import Study, User
from tests.app.pages.entries.test_errors_at_fields import Sent, held_against, refused

TEMPLATES = Path(__file__).parents[4] / "app" / "templates"
NEW = "a much longer pass phrase 7"


def test_forms_of_accounts_say_errors_at_their_fields(browser: TestClient, db: Session) -> None:
    other = {"email": "other@clinic.example", "name": "Other", "role": "engineer", "password": "four words of nothing at all"}
    assert browser.post("/accounts", data=other).status_code == 303
    number = db.scalar(select(User.id).where(User.email == other["email"]))
    token = {"name": "tablet", "scope": "full", "days": "30"}
    change = {"present": "wrong", "password": NEW, "again": NEW}
    new, again = other | {"email": "third@clinic.example"}, f"/accounts/{number}/password"
    forms = [
        Sent("/account/tokens", token | {"days": "many"}, "f-token-days", "'many' is no number", 'value="tablet"'),
        Sent("/account/tokens", token | {"days": "9999"}, "f-token-days", "cannot last 9999 days", 'value="9999"'),
        Sent("/account/tokens", token | {"name": " "}, "f-token-name", "needs a name", 'value="30"'),
        Sent("/account/tokens", token | {"scope": "all"}, "f-token-scope", "Choose what", 'value="tablet"'),
        Sent("/account/password", change | {"again": "another"}, "f-password-again", "differ", 'id="f-password-again"'),
        Sent("/account/password", change | {"password": "x", "again": "x"}, "f-password-password", "at least", 'id="f-password-again"'),
        Sent("/accounts", new | {"email": "nobody"}, "f-new-email", "is no e-mail address", 'value="Other"'),
        Sent("/accounts", other, "f-new-email", "There is already a user", 'value="Other"'),
        Sent("/accounts", new | {"password": "x"}, "f-new-password", "at least", 'value="third@clinic.example"'),
        Sent("/accounts", new | {"role": "king"}, "f-new-role", "Choose a role", 'value="third@clinic.example"'),
        Sent(again, {"password": "x"}, f"f-user-{number}-password", "at least", f'id="f-user-{number}-password"'),
    ]
    assert refused(browser, forms) == {}
    page = browser.post(again, data={"password": "x"}).text
    assert page.count('class="field-note"') == 1, "not at the new user's password too"
    page = browser.post("/account/password", data=change)
    assert page.status_code == 403
    assert re.search(r'id="n-password-present">The password is wrong', page.text), "a wrong password is said where it was typed"
    assert NEW not in page.text


def test_forms_of_studies_say_errors_at_their_fields(browser: TestClient, db: Session) -> None:
    code = db.scalar(select(Study.code))
    here, id_of = f"/studies/{code}", f"f-studies-{code}"
    forms = [
        Sent("/studies", {"code": code, "name": "Second"}, "f-studies-code", "There is already a study", 'id="f-studies-code"'),
        Sent(here, {"name": "Other", "reason": " "}, f"{id_of}-reason", "There is no reason", f'id="{id_of}-reason"'),
        Sent(f"{here}/end", {"reason": ""}, f"{id_of}-end-reason", "There is no reason", f'id="{id_of}-end-reason"'),
        Sent(f"{here}/sites", {"code": "", "name": "South"}, f"{id_of}-sites-code", "", f'id="{id_of}-sites-code"'),
        Sent(f"{here}/members", {"email": "nobody@x.example", "role": "engineer"}, f"{id_of}-members-email", "Add the user first",
             f'id="{id_of}-members-email"'),
    ]  # fmt: skip
    assert refused(browser, forms) == {}
    assert browser.post(f"{here}/end", data={"reason": ""}).text.count('class="field-note"') == 1


def test_a_wrong_password_of_a_signature_is_said_at_it(browser: TestClient, session_id: int) -> None:
    forms = [
        Sent("/participants/P1/margins/lock", {"version": "1", "lock_reason": "agreed", "password": "wrong"}, "f-password", "",
             'value="agreed"'),
        Sent("/visits/1/lock", {"lock_reason": "complete", "password": "wrong"}, "f-password", "The password is wrong", 'value="complete"'),
    ]  # fmt: skip
    found = {}
    for sent in forms:
        answer = browser.post(sent.address, data=sent.typed)
        assert answer.status_code in (403, 409, 422), answer.text
        found[sent.address] = held_against(answer.text, sent)
    assert found == {sent.address: [] for sent in forms}


SAYS_IT_ON_TOP = {
    "accounts/sign_in.html": "which of address, password and code is wrong is not told",
    "base.html": "a search, which is not sent as a form",
    "overview/styleguide.html": "shows the parts of forms, and sends none",
    "ingest/markers.html": "its fields are cells of a table, and the box on top names marker and column",
    "evaluation/ranking.html": "is sent to the page of policies or of plans, which says at its own fields what is wrong",
}
"""Templates whose forms take text and say what is wrong in the box on top alone, and why."""
TAKES = re.compile(r"<textarea|<input(?![^>]*type=\"(?:hidden|checkbox|radio|submit|file)\")[^>]*>|\{\{ (?:field|textarea)\(")
POSTS = re.compile(r"method=\"post\"|\{% call form\(")


def test_every_form_that_takes_text_says_errors_at_its_fields() -> None:
    silent = set()
    for path in TEMPLATES.rglob("*.html"):
        text = path.read_text()
        if POSTS.search(text) and TAKES.search(text) and not re.search(r"note=|at_field\(|said\(|identity_again\(.*notes", text):
            silent.add(path.relative_to(TEMPLATES).as_posix())
    assert silent == set(SAYS_IT_ON_TOP)
