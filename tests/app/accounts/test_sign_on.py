"""Signing on at a hospital's identity provider: who it lets in, who it does not, what it confirms, and what the trail says of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import httpx2 as httpx
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app import cli
from app.accounts import service as accounts
from app.accounts import sign_on
from app.accounts import sign_on_provider as ours
from app.accounts.sign_on_provider import Identity
from app.platform.database import new_session, now
from app.settings import get_settings
from app.tables.accounts import Role, User
from tests import identity_provider as theirs
from tests.conftest import PASSWORD

PUBLIC = "https://betaloop.example"
ADA, BOB = theirs.Person("7f3a", "ada@clinic.example"), theirs.Person("91bc", "bob@clinic.example")


@pytest.fixture
def hospital(monkeypatch: pytest.MonkeyPatch, fresh_database: str) -> Iterator[theirs.Provider]:
    """A provider that this installation knows, at which Ada sits at the browser."""
    with theirs.running(f"{PUBLIC}/sign-on/return") as provider:
        provider.person = ADA
        named = {"OIDC_ISSUER": provider.issuer, "OIDC_CLIENT_ID": theirs.CLIENT_ID, "OIDC_CLIENT_SECRET": theirs.CLIENT_SECRET}
        for name, value in (named | {"PUBLIC_URL": PUBLIC, "OIDC_NAME": "St. Elsewhere"}).items():
            monkeypatch.setenv(f"BETALOOP_{name}", value)
        get_settings.cache_clear()
        yield provider
    get_settings.cache_clear()


@pytest.fixture
def ada(db: Session) -> User:
    user = accounts.add_user(db, ADA.email, Role.CLINICIAN, PASSWORD)
    db.commit()
    return user


@pytest.fixture
def browser(service_app: Any, hospital: theirs.Provider) -> Iterator[TestClient]:
    with TestClient(service_app, headers={"Accept": "text/html"}, follow_redirects=False) as client:
        yield client


def sent_back(browser: TestClient, begin: str) -> str:
    """Begin, and let the provider ask; the path to which it sends the browser back."""
    begun = browser.get(begin)
    assert begun.status_code == 303, begun.text
    back = httpx.get(begun.headers["location"])
    assert back.status_code == 302, back.text
    parts = urlsplit(back.headers["location"])
    assert f"{parts.scheme}://{parts.netloc}" == PUBLIC
    return f"{parts.path}?{parts.query}"


def signed_on(browser: TestClient, begin: str = "/sign-on?next=/account") -> httpx.Response:
    return browser.get(sent_back(browser, begin))


def remember(browser: TestClient, begun: str) -> None:
    """Set this cookie of a begin in a browser, and no other."""
    browser.cookies.clear()
    browser.cookies.set("betaloop_sign_on", begun)


def trail(db: Session, entity: str) -> list[tuple[str, str]]:
    found = db.execute(text("select action, actor from audit_event where entity = :e order by id"), {"e": entity})
    return [tuple(row) for row in found]


def test_somebody_with_an_account_is_let_in_linked_once_and_in_the_trail(
    browser: TestClient, hospital: theirs.Provider, ada: User, db: Session
) -> None:
    assert "St. Elsewhere" in browser.get("/sign-in?next=/account").text
    answer = signed_on(browser)
    assert (answer.status_code, answer.headers["location"]) == (303, "/account")
    assert "httponly" in answer.headers["set-cookie"].lower()
    assert "Signs you in since" in browser.get("/account").text
    # the address may change at the hospital: the link is to the person
    hospital.present = None
    hospital.person = theirs.Person(ADA.subject, "ada.married@clinic.example")
    assert signed_on(browser).status_code == 303
    assert trail(db, "sign_on_link") == [("insert", ADA.email)]
    assert trail(db, "sign_in") == [("insert", ADA.email)] * 2
    assert db.scalars(text("select distinct issuer from sign_in")).all() == [hospital.issuer]


@pytest.mark.parametrize(
    "person", [theirs.Person("x", "nobody@clinic.example"), theirs.Person("x", ADA.email, email_verified=False), theirs.Person("x", "")]
)
def test_nobody_without_an_account_is_let_in_and_none_is_made(
    person: theirs.Person, browser: TestClient, hospital: theirs.Provider, ada: User, db: Session
) -> None:
    hospital.person = person
    answer = signed_on(browser)
    assert answer.status_code == 403
    assert "no account here" in answer.text
    assert browser.get("/account").status_code == 303
    assert db.scalar(text("select count(*) from app_user")) == 1
    assert db.scalar(text("select count(*) from sign_on_link")) == 0
    assert trail(db, "sign_on") == [("refuse", "unknown")]


def test_an_address_that_was_given_to_somebody_else_opens_no_account(
    browser: TestClient, hospital: theirs.Provider, ada: User, db: Session
) -> None:
    assert signed_on(browser).status_code == 303
    hospital.present, hospital.person = None, theirs.Person("new-colleague", ADA.email)
    assert "another person" in signed_on(browser).text
    assert trail(db, "sign_on") == [("refuse", "unknown")], "whoever came is not the owner of the account"
    first = browser.get("/account").status_code
    done = CliRunner().invoke(cli.app, ["user", "remove-sign-on", ADA.email])
    assert done.exit_code == 0, done.output
    assert (first, browser.get("/account").status_code) == (200, 303), "sessions of the old identity have ended"
    assert signed_on(browser).status_code == 303, "linked anew once an administrator has let go of the old one"


def test_a_closed_account_stays_closed(browser: TestClient, ada: User, db: Session) -> None:
    assert signed_on(browser).status_code == 303
    ada.active = False
    db.commit()
    assert browser.get("/account").status_code == 303, "the session has ended"
    refused = signed_on(browser)
    assert (refused.status_code, "closed" in refused.text) == (403, True)


def test_locked_passwords_do_not_lock_the_sign_on_and_a_new_password_ends_its_sessions(browser: TestClient, ada: User) -> None:
    codes = [browser.post("/sign-in", data={"email": ADA.email, "password": "wrong"}).status_code for _ in range(6)]
    assert codes[-1] == 429
    assert signed_on(browser).status_code == 303, "else anybody could shut anybody out"
    with new_session() as db:
        accounts.set_password(db, db.get_one(User, ada.id), "another horse battery")
        db.commit()
    assert browser.get("/account").status_code == 303


def _claims(**change: Any) -> Callable[[theirs.Provider], None]:
    return lambda hospital: hospital.change.update(change)


def _other_key(hospital: theirs.Provider) -> None:
    known = hospital.published
    hospital.renew_key()
    hospital.key = theirs.RSAKey.import_key(hospital.key.as_dict(private=True) | {"kid": known[0].kid})
    hospital.published = known


@pytest.mark.parametrize(
    "forge",
    [
        _claims(nonce="of another sign-on"),
        _claims(nonce=None),
        _claims(aud="another service"),
        _claims(aud=[theirs.CLIENT_ID, "another service"], azp="another service"),
        _claims(iss="https://evil.example"),
        _claims(exp=time.time() - 3600),
        _claims(iat=time.time() + 3600),
        _claims(sub=None),
        _claims(sub=17),
        _claims(sub="x" * 300),
        _claims(auth_time=None),
        _claims(auth_time=time.time() - 7200),
        _claims(auth_time=int(time.time()) + 3600),
        _claims(at_hash="AAAA"),
        _other_key,
        theirs.Provider.sign_with_the_public_key,
        lambda hospital: setattr(hospital, "algorithm", "none"),
        lambda hospital: setattr(hospital, "secret", "changed there"),
    ],
    ids=[
        *(
            "nonce",
            "no-nonce",
            "aud",
            "azp",
            "iss",
            "expired",
            "early",
            "no-sub",
            "sub-type",
            "long-sub",
            "no-auth-time",
            "old-auth-time",
            "early-auth-time",
            "at-hash",
        ),
        *("other-key", "public-key", "unsigned", "secret"),
    ],
)
def test_what_cannot_be_verified_lets_nobody_in(
    forge: Callable[[theirs.Provider], None], browser: TestClient, hospital: theirs.Provider, ada: User
) -> None:
    forge(hospital)
    assert signed_on(browser).status_code == 403
    assert browser.get("/account").status_code == 303


def test_an_answer_counts_once_and_in_the_browser_that_began(browser: TestClient, service_app: Any, ada: User) -> None:
    back = sent_back(browser, "/sign-on")
    with TestClient(service_app, headers={"Accept": "text/html"}, follow_redirects=False) as other:
        assert other.get(back).status_code == 403, "somebody else was given the address"
        stolen = sent_back(other, "/sign-on")
        assert "another sign-on" in browser.get(stolen).text, "refused by its state, before its code is looked at"
    assert browser.get(back).status_code == 403, "the begin was used up by the wrong answer"
    right = sent_back(browser, "/sign-on")
    assert "another provider" in browser.get(right.replace("iss=", "iss=https%3A%2F%2Fevil.example%2F")).text
    again = sent_back(browser, "/sign-on")
    kept = dict(browser.cookies)
    assert browser.get(again).status_code == 303
    remember(browser, kept["betaloop_sign_on"])
    assert browser.get(again).status_code == 403, "the code was used"


def test_a_begin_ends_after_ten_minutes_and_cannot_be_made_up(browser: TestClient, ada: User, monkeypatch: pytest.MonkeyPatch) -> None:
    back = sent_back(browser, "/sign-on")
    begun = browser.cookies["betaloop_sign_on"]
    for made_up in ("", "x", "é".encode().hex(), begun[:-4] + "AAAA"):
        remember(browser, made_up)
        assert browser.get(back).status_code == 403
    later = time.time() + 601
    monkeypatch.setattr("app.accounts.sign_on_web.time.time", lambda: later)
    remember(browser, begun)
    assert browser.get(back).status_code == 403


def test_refusals_of_one_address_come_to_an_end(browser: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.accounts.deps.failed_sign_ins._most", lambda: 5)
    back = sent_back(browser, "/sign-on")
    begun = browser.cookies["betaloop_sign_on"]
    codes = []
    for _ in range(6):
        remember(browser, begun)
        codes.append(browser.get(back.replace("state=", "state=x")).status_code)
    assert codes == [403] * 5 + [429]


def test_a_refusal_there_and_a_provider_that_is_away_are_said(browser: TestClient, hospital: theirs.Provider) -> None:
    hospital.person = None
    refused = signed_on(browser)
    assert (refused.status_code, "not completed" in refused.text) == (403, True)
    hospital.issuer = "https://another.example"
    away = ours.Provider(get_settings().oidc_issuer or "", theirs.CLIENT_ID, "", PUBLIC)
    with pytest.raises(ours.ProviderAway, match=r"St\. Elsewhere"):
        away.metadata()
    with pytest.raises(ours.ProviderAway):
        ours.Provider("http://127.0.0.1:9", theirs.CLIENT_ID, "", PUBLIC).metadata()


def test_a_provider_that_is_away_uses_up_no_tries(
    browser: TestClient, hospital: theirs.Provider, ada: User, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.accounts.deps.failed_sign_ins._most", lambda: 5)
    back = sent_back(browser, "/sign-on")
    begun = browser.cookies["betaloop_sign_on"]

    def away(*_: Any) -> Any:
        raise ours.ProviderAway("St. Elsewhere does not answer as it should.")

    with monkeypatch.context() as patch:
        patch.setattr(ours.Provider, "_exchanged", away)
        codes = []
        for _ in range(8):
            remember(browser, begun)
            codes.append(browser.get(back).status_code)
    assert codes == [503] * 8
    remember(browser, begun)
    assert browser.get(back).status_code == 303, "it is back, and nobody has to wait"


def test_renewed_keys_are_read_again_but_not_for_every_forged_token(
    browser: TestClient, hospital: theirs.Provider, ada: User, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert signed_on(browser).status_code == 303
    hospital.renew_key()
    assert signed_on(browser).status_code == 403, "lately read"
    monkeypatch.setattr(ours, "_KEYS_AGAIN_S", 0.0)
    assert signed_on(browser).status_code == 303
    assert hospital.key_reads == 2


def test_who_signs_out_is_asked_again_and_can_sign_out_there(browser: TestClient, hospital: theirs.Provider, ada: User) -> None:
    assert signed_on(browser).status_code == 303
    assert signed_on(browser).status_code == 303
    assert hospital.asked == 1, "they are signed in there"
    out = browser.post("/sign-out", headers={"Sec-Fetch-Site": "same-origin"})
    assert browser.get("/account").status_code == 303
    assert "/sign-on/end" in browser.get(out.headers["location"]).text
    hospital.person = BOB
    assert signed_on(browser).status_code == 403, "somebody else at the same tablet is not Ada"
    assert hospital.asked == 2
    hospital.person = ADA
    assert signed_on(browser).status_code == 303
    end = browser.get("/sign-on/end").headers["location"]
    assert httpx.get(end).headers["location"] == f"{PUBLIC}/sign-in"
    assert hospital.present is None


def test_somebody_who_signed_on_there_long_ago_is_asked_again(browser: TestClient, hospital: theirs.Provider, ada: User) -> None:
    hospital.present = (ADA, time.time() - 60 * get_settings().session_idle_minutes - 1)
    hospital.person = BOB
    assert signed_on(browser).status_code == 403
    assert hospital.asked == 1


@pytest.mark.parametrize(
    ("vouched", "same"),
    [
        ("ada@clinic.example", True),
        (" ADA@Clinic.Example ", True),
        ("ａｄａ@clinic.example", False),
        ("ada@ｃlinic.example", False),
        ("ᴀda@clinic.example", False),
        ("ada@clinic.example\u200b", False),
        ("strasse@clinic.example", True),
        ("straße@clinic.example", False),
        ("nobody@clinic.example", False),
        ("", False),
        (None, False),
    ],
)
def test_an_account_belongs_to_exactly_the_address_that_is_vouched_for(db: Session, ada: User, vouched: str | None, same: bool) -> None:
    accounts.add_user(db, "strasse@clinic.example", Role.VIEWER, PASSWORD)
    db.commit()
    found = sign_on._user_of(db, vouched)
    assert (found is not None) is same
    if found is not None and vouched is not None:
        assert found.email == vouched.strip().lower()


def test_look_alikes_of_an_address_open_no_account(browser: TestClient, hospital: theirs.Provider, ada: User, db: Session) -> None:
    for number, look_alike in enumerate(("ａda@clinic.example", "ada＠clinic.example", "ada@clinic。example", "ᵃda@clinic.example")):
        hospital.present, hospital.person = None, theirs.Person(f"x{number}", look_alike)
        assert signed_on(browser).status_code == 403, look_alike
    assert db.scalar(text("select count(*) from sign_on_link")) == 0
    hospital.present, hospital.person = None, ADA
    assert signed_on(browser).status_code == 303


def test_two_first_sign_ons_of_one_person_at_once_are_one_link(ada: User, db: Session) -> None:
    who = Identity(PUBLIC, ADA.subject, ADA.email, now())
    opened: list[str] = []

    def second() -> None:
        with new_session() as own:
            opened.append(sign_on.sign_on(own, who))
            own.commit()

    with new_session() as first:
        opened.append(sign_on.sign_on(first, who))
        other = threading.Thread(target=second)
        other.start()
        other.join(1.0)
        assert other.is_alive(), "it waits for the first"
        first.commit()
    other.join(20.0)
    assert len(opened) == 2
    assert db.scalar(text("select count(*) from sign_on_link")) == 1


def test_an_installation_without_a_sign_on_shows_none(anonymous_client: TestClient) -> None:
    assert "sign-on" not in anonymous_client.get("/sign-in").text
    for path in ("/sign-on", "/sign-on/return", "/sign-on/end"):
        assert anonymous_client.get(path).status_code == 404


@pytest.fixture
def anonymous_client(service_app: Any) -> Iterator[TestClient]:
    with TestClient(service_app, headers={"Accept": "text/html"}, follow_redirects=False) as client:
        yield client


def test_settings_that_do_not_fit_are_said_at_the_start(fresh_database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BETALOOP_OIDC_ISSUER", "http://login.hospital.example")
    get_settings.cache_clear()
    with pytest.raises(RuntimeError, match="BETALOOP_OIDC_CLIENT_ID, BETALOOP_PUBLIC_URL"):
        ours.provider()
    monkeypatch.setenv("BETALOOP_OIDC_CLIENT_ID", "x")
    monkeypatch.setenv("BETALOOP_PUBLIC_URL", PUBLIC)
    get_settings.cache_clear()
    with pytest.raises(RuntimeError, match="give an address with https"):
        ours.provider()
    get_settings.cache_clear()
