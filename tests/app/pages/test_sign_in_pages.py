"""Signing in and out, one's own access, and the users of a study."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient

from app.accounts.pages import local_path

PASSWORD = "correct horse battery"
ADMIN = "admin-page@clinic.example"


def test_a_page_sends_a_stranger_to_sign_in_and_back(anonymous: TestClient, sign_in: Callable[[str], TestClient]) -> None:
    refused = anonymous.get("/audit")
    assert (refused.status_code, refused.headers["location"]) == (303, "/sign-in?next=/audit")
    sign_in("admin")
    form = anonymous.get(refused.headers["location"])
    assert 'name="next" value="/audit"' in form.text
    answer = anonymous.post("/sign-in", data={"email": ADMIN, "password": PASSWORD, "next": "/audit"})
    assert (answer.status_code, answer.headers["location"]) == (303, "/audit")
    assert anonymous.get("/audit").status_code == 200


def test_the_cookie_is_out_of_reach_of_scripts_and_other_sites(anonymous: TestClient, sign_in: Callable[[str], TestClient]) -> None:
    sign_in("admin")
    cookie = anonymous.post("/sign-in", data={"email": ADMIN, "password": PASSWORD}).headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=lax" in cookie


def test_a_wrong_password_keeps_the_address_and_says_no_more(anonymous: TestClient, sign_in: Callable[[str], TestClient]) -> None:
    sign_in("admin")
    wrong = anonymous.post("/sign-in", data={"email": ADMIN, "password": "something else"})
    unknown = anonymous.post("/sign-in", data={"email": "nobody@clinic.example", "password": "something else"})
    assert (wrong.status_code, unknown.status_code) == (401, 401)
    sentence = "The e-mail address or the password is wrong."
    assert sentence in wrong.text
    assert sentence in unknown.text
    assert f'value="{ADMIN}"' in wrong.text
    assert "something else" not in wrong.text


def test_six_failures_lock_the_address_for_a_while(anonymous: TestClient, sign_in: Callable[[str], TestClient]) -> None:
    sign_in("admin")
    codes = [anonymous.post("/sign-in", data={"email": ADMIN, "password": "wrong"}).status_code for _ in range(6)]
    assert codes == [401] * 5 + [429]
    assert anonymous.post("/sign-in", data={"email": ADMIN, "password": PASSWORD}).status_code == 429


def test_a_padded_address_neither_passes_the_limit_nor_tells_the_right_password(
    anonymous: TestClient, sign_in: Callable[[str], TestClient]
) -> None:
    sign_in("admin")
    padding = [" ", "  ", "\0", " \0 ", "\0\0 ", " \0\0"]
    codes = {anonymous.post("/sign-in", data={"email": ADMIN + pad, "password": PASSWORD}).status_code for pad in padding if "\0" in pad}
    assert codes == {401}, "no address has a zero character, with whatever password"
    codes_of_spaces = [anonymous.post("/sign-in", data={"email": ADMIN + " " * n, "password": "wrong"}).status_code for n in range(6)]
    assert codes_of_spaces == [401] * 5 + [429]
    for pad in padding:
        assert anonymous.post("/sign-in", data={"email": ADMIN + pad, "password": PASSWORD}).status_code in (401, 429)


@pytest.mark.parametrize(
    "target",
    ["https://evil.example", "//evil.example", "/\\evil.example", "\\\\evil.example", "/\t/evil.example", "javascript:alert(1)", "", "/é"],
)
def test_nobody_is_sent_to_another_site(target: str) -> None:
    assert local_path(target) == "/"


def test_an_outward_next_leads_home(anonymous: TestClient, sign_in: Callable[[str], TestClient]) -> None:
    sign_in("admin")
    answer = anonymous.post("/sign-in", data={"email": ADMIN, "password": PASSWORD, "next": "https://evil.example/"})
    assert answer.headers["location"] == "/"
    assert anonymous.get("/sign-in?next=//evil.example").headers["location"] == "/"


def test_local_paths_keep_their_query() -> None:
    assert local_path("/audit?entity=visit&offset=50") == "/audit?entity=visit&offset=50"


def test_signing_out_ends_the_session_on_the_server(browser: TestClient) -> None:
    token = browser.cookies["betaloop_session"]
    assert browser.get("/").status_code == 200
    assert browser.post("/sign-out").headers["location"] == "/sign-in?done=out"
    browser.cookies["betaloop_session"] = token
    assert browser.get("/").status_code == 303


def test_posts_from_another_site_are_refused(browser: TestClient) -> None:
    for headers in ({"Sec-Fetch-Site": "cross-site"}, {"Sec-Fetch-Site": "", "Origin": "https://evil.example"}):
        assert browser.post("/participants", data={"code": "EVIL"}, headers=headers).status_code == 403
    assert browser.get("/participants/EVIL").status_code == 404


@pytest.mark.parametrize("authorization", ["Basic x", "Bearer x", "Bearer ", "x"])
def test_an_authorization_header_beside_the_cookie_lets_no_other_site_in(browser: TestClient, authorization: str) -> None:
    headers = {"Sec-Fetch-Site": "cross-site", "Origin": "https://evil.example", "Authorization": authorization}
    for path in ("/participants", "/sign-out", "/account/tokens"):
        assert browser.post(path, data={"code": "EVIL", "name": "evil"}, headers=headers).status_code == 403, path
    assert browser.get("/").status_code == 200


def test_a_server_error_has_every_header_and_logs_no_values(
    service_app,
    sign_in: Callable[[str], TestClient],
    capsys: pytest.CaptureFixture[str],  # type: ignore[no-untyped-def]
) -> None:
    from sqlalchemy import text

    from app.platform.database import new_session

    patient = "-".join(("NAME", "OF", "PATIENT"))  # put together, for a traceback quotes lines of source

    @service_app.get("/broken")
    def broken() -> None:
        with new_session() as db:
            db.execute(text("select 1 / cast(:zero as integer), cast(:name as text)"), {"zero": 0, "name": patient})

    answer = TestClient(service_app, raise_server_exceptions=False).get("/broken")
    assert answer.status_code == 500
    assert answer.headers["Content-Security-Policy"].startswith("default-src 'self'")
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert answer.headers["X-Request-ID"] in answer.json()["hint"]
    assert not any(told in answer.text for told in (patient, "Traceback", "division", "cast("))
    printed = capsys.readouterr()
    assert "division by zero" in printed.err
    assert patient not in printed.out + printed.err


def test_a_token_is_shown_once_works_and_can_be_revoked(browser: TestClient, service_app) -> None:  # type: ignore[no-untyped-def]
    page = browser.post("/account/tokens", data={"name": "upload <tablet>"}).text
    token = re.search(r"blp_[\w-]+", page)
    assert token is not None
    assert token[0] not in browser.get("/account").text
    program = TestClient(service_app, headers={"Authorization": f"Bearer {token[0]}"})
    assert program.get("/api/v1/participants").status_code == 200
    revoke = re.search(r"/account/tokens/\d+/revoke", browser.get("/account").text)
    assert revoke is not None
    assert browser.post(revoke[0]).status_code == 303
    assert program.get("/api/v1/participants").status_code == 401
    assert browser.post("/account/tokens", data={"name": ""}).status_code == 422


def test_a_new_password_needs_the_present_one_and_ends_all_sessions(browser: TestClient) -> None:
    fields = {"present": "not mine at all", "password": "another long one", "again": "another long one"}
    assert browser.post("/account/password", data=fields).status_code == 403
    assert browser.post("/account/password", data=fields | {"present": PASSWORD, "again": "different one"}).status_code == 422
    done = browser.post("/account/password", data=fields | {"present": PASSWORD})
    assert done.headers["location"] == "/sign-in?done=password"
    assert browser.get("/").status_code == 303
    assert browser.post("/sign-in", data={"email": ADMIN, "password": "another long one"}).status_code == 303


def test_an_administrator_adds_closes_and_opens_accounts(browser: TestClient, anonymous: TestClient) -> None:
    draft = {"email": "new@clinic.example", "name": "<i>N</i>", "role": "viewer", "password": "a first password"}
    assert browser.post("/accounts", data=draft).headers["location"] == "/accounts?done=added"
    assert browser.post("/accounts", data=draft).status_code == 409
    assert browser.post("/accounts", data=draft | {"email": "x@y", "role": "owner"}).status_code == 422
    page = browser.get("/accounts").text
    assert "&lt;i&gt;N&lt;/i&gt;" in page
    user = re.search(r"/accounts/(\d+)/active", page)
    assert user is not None
    known = {"email": draft["email"], "password": draft["password"]}
    assert anonymous.post("/sign-in", data=known).status_code == 303
    assert browser.post(user[0], data={"active": "no"}).status_code == 303
    assert anonymous.get("/").status_code == 303
    assert anonymous.post("/sign-in", data=known).status_code == 401
    assert browser.post(user[0], data={"active": "yes"}).headers["location"] == "/accounts?done=opened"
    assert anonymous.post("/sign-in", data=known).status_code == 303


def test_only_administrators_see_accounts(sign_in: Callable[[str], TestClient]) -> None:
    clinician = sign_in("clinician")
    assert clinician.get("/accounts").status_code == 403
    assert clinician.post("/accounts", data={"email": "a@b.c", "role": "admin", "password": "long enough here"}).status_code == 403
    assert clinician.post("/accounts/1/active", data={"active": "no"}).status_code == 403
    assert 'href="/accounts"' not in clinician.get("/").text
