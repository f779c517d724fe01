"""Tries to sign in whose verdict could not be written lock no user out for longer than a minute; wrong ones still do."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from app.accounts import service
from app.accounts.deps import failed_sign_ins
from app.platform.errors import Forbidden, TooMany, Unauthorized, passing
from app.tables.accounts import Role, User

EMAIL, PASSWORD, WRONG = "ada@clinic.example", "correct horse battery", "a wrong guess"
REFUSING = """
create function no_room() returns trigger language plpgsql as $$ begin
    raise exception 'could not extend file: No space left on device' using errcode = 'disk_full';
end $$;
create constraint trigger no_room after update or delete on sign_in_attempt deferrable initially deferred
    for each row execute function no_room();
"""
"""A database that takes a try, and has no room when its verdict is committed."""


@pytest.fixture
def ada(db: Session) -> User:
    user = service.add_user(db, EMAIL, Role.CLINICIAN, PASSWORD)
    db.commit()
    return user


@pytest.fixture
def full(db: Session, ada: User, owner_db: Session) -> Callable[[bool], None]:
    """Function that fills the database from now on, or no more."""

    def make(full: bool) -> None:
        db.rollback()  # else the owner waits for it
        owner_db.execute(text(REFUSING if full else "drop function no_room cascade"))
        owner_db.commit()

    return make


def sign_in(db: Session, password: str) -> str:
    """Sign in as a page does: what is opened is committed."""
    token = service.sign_in(db, EMAIL, password)
    db.commit()
    return token


def later(db: Session, seconds: int) -> None:
    """Move the clock forward by so many seconds."""
    db.execute(text("update sign_in_attempt set at = at - make_interval(secs => :seconds)"), {"seconds": seconds})
    db.commit()


def without_verdict(db: Session, act: Callable[[], object]) -> None:
    """Make as many tries as are judged, none of which gets a verdict."""
    for _ in range(service.FAILURES_ALLOWED):
        with pytest.raises(OperationalError) as told:
            act()
        error = passing(told.value)
        assert error is not None
        assert error.status == 507
        db.rollback()


@pytest.mark.parametrize("tried", ["right", "wrong", "confirmed", "not confirmed"])
def test_tries_that_were_told_no_verdict_count_for_a_minute_alone(db: Session, ada: User, full: Callable[[bool], None], tried: str) -> None:
    acts: dict[str, Callable[[], object]] = {
        "right": lambda: sign_in(db, PASSWORD),
        "wrong": lambda: sign_in(db, WRONG),
        "confirmed": lambda: service.confirm_password(ada.id, PASSWORD),
        "not confirmed": lambda: service.confirm_password(ada.id, WRONG),
    }
    full(True)
    without_verdict(db, acts[tried])
    full(False)
    with pytest.raises(TooMany, match=r"are waiting for an answer\. Wait 60 seconds") as refused:
        sign_in(db, PASSWORD)
    assert refused.value.retry_after_s == 60
    later(db, 61)
    assert sign_in(db, PASSWORD)


def test_wrong_ones_after_them_lock_the_address_as_ever(db: Session, ada: User, full: Callable[[bool], None]) -> None:
    full(True)
    without_verdict(db, lambda: sign_in(db, WRONG))
    full(False)
    later(db, 61)
    for _ in range(service.FAILURES_ALLOWED):
        with pytest.raises(Unauthorized):
            sign_in(db, WRONG)
    later(db, 61)
    with pytest.raises(TooMany, match=r"Too many failed sign-ins for ada@clinic\.example\. Wait 15 minutes") as refused:
        sign_in(db, PASSWORD)
    assert refused.value.retry_after_s == 900


def test_undecided_tries_count_beside_failed_ones(db: Session, ada: User, full: Callable[[bool], None]) -> None:
    for _ in range(service.FAILURES_ALLOWED - 1):
        with pytest.raises(Forbidden):
            service.confirm_password(ada.id, WRONG)
    full(True)
    with pytest.raises(OperationalError):
        sign_in(db, WRONG)
    full(False)
    with pytest.raises(TooMany, match="are waiting for an answer"):
        sign_in(db, PASSWORD)
    later(db, 61)
    with pytest.raises(Unauthorized):
        sign_in(db, WRONG)
    with pytest.raises(TooMany, match="Too many failed"):
        sign_in(db, PASSWORD)


def test_a_wrong_try_that_a_right_one_has_dropped_meanwhile_is_told_so_all_the_same(db: Session, ada: User) -> None:
    attempt = service._count_attempt(db, EMAIL, known=True)
    assert sign_in(db, PASSWORD)
    service.repository.mark_failed(db, attempt)
    db.commit()
    assert db.execute(text("select count(*) from sign_in_attempt")).scalar_one() == 0


def test_they_do_not_count_against_where_they_came_from(
    service_app: object, full: Callable[[bool], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(failed_sign_ins, "_most", lambda: 2)
    browser = TestClient(service_app, headers={"Accept": "text/html", "Sec-Fetch-Site": "same-origin"})  # type: ignore[arg-type]
    full(True)
    for i in range(4):
        answer = browser.post("/sign-in", data={"email": f"p{i}@clinic.example", "password": WRONG})
        assert (answer.status_code, "no room left on the disk" in answer.text) == (507, True)
    full(False)
    form = {"email": EMAIL, "password": WRONG}
    assert [browser.post("/sign-in", data=form).status_code for _ in range(3)] == [401, 401, 429]
