"""Argon2 runs for two people at a time, whatever they give a password for, and those who wait leave threads to everybody else."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from fastapi.testclient import TestClient
from pwdlib.hashers.argon2 import Argon2Hasher
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts import passwords, service
from app.accounts.deps import COOKIE
from app.platform.database import transaction
from app.platform.errors import TooMany
from app.tables.accounts import Role, User
from tests.conftest import PASSWORD

NEW = "another good password"
ADA = "ada@clinic.example"
AT_A_TIME = 0.03
"""Seconds that a hash takes here at least."""


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of hashes that were running whenever one began; each is real, and lasts AT_A_TIME longer."""
    running, seen, lock = [0], [], threading.Lock()

    def noted(real: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any, **named: Any) -> Any:
            with lock:
                running[0] += 1
                seen.append(running[0])
            time.sleep(AT_A_TIME)
            try:
                return real(*arguments, **named)
            finally:
                with lock:
                    running[0] -= 1

        return run

    for name in ("hash", "verify"):
        monkeypatch.setattr(Argon2Hasher, name, noted(getattr(Argon2Hasher, name)))
    return seen


@pytest.fixture
def ada(db: Session) -> int:
    user = service.add_user(db, ADA, Role.ADMIN, PASSWORD)
    db.commit()
    return user.id


def in_threads(acts: list[Callable[[], object]]) -> list[object]:
    """Run acts that begin at the same moment, each in a thread of its own; return their results or errors."""
    gate = threading.Barrier(len(acts))

    def run(act: Callable[[], object]) -> object:
        gate.wait(30)
        try:
            return act()
        except TooMany as error:
            return error

    with ThreadPoolExecutor(len(acts)) as threads:
        return list(threads.map(run, acts))


def test_the_service_hashes_with_it() -> None:
    assert [type(h) for h in service._hasher.hashers] == [passwords.FewAtOnce]


def test_two_at_a_time_whoever_asks_and_for_whatever(ada: int, at_once: list[int]) -> None:
    def added(i: int) -> None:
        with transaction("test") as db:
            service.add_user(db, f"new{i}@clinic.example", Role.VIEWER, PASSWORD)

    def reset() -> None:
        with transaction("test") as db:
            service.set_password(db, db.get_one(User, ada), PASSWORD)

    def signed_in() -> None:
        with transaction("test") as db:
            service.sign_in(db, ADA, PASSWORD)

    acts: list[Callable[[], object]] = [lambda i=i: added(i) for i in range(6)]  # type: ignore[misc]
    # a try counts until it has proved right, and five of one account at once are too many
    acts += [reset, lambda: service.confirm_password(ada, PASSWORD), signed_in] * 2
    assert in_threads(acts) == [None] * len(acts)
    assert len(at_once) == len(acts)
    assert max(at_once) == 2, "and two cores are used"


def test_who_finds_too_many_waiting_is_asked_to_come_back_and_has_tried_nothing(ada: int, db: Session, at_once: list[int]) -> None:
    many = passwords.MOST_PRESENT + 6
    stored = db.get_one(User, ada).password_hash
    people = [
        User(email=f"p{i}@clinic.example", password_hash=stored) for i in range(many)
    ]  # of one account, five tries at once are too many
    db.add_all(people)
    db.commit()
    answers = in_threads([lambda i=p.id: service.confirm_password(i, PASSWORD) for p in people])  # type: ignore[misc]
    refused = [a for a in answers if isinstance(a, TooMany)]
    assert 0 < len(refused) <= 6
    assert len(at_once) == many - len(refused)
    assert max(at_once) == 2
    assert refused[0].hint == "Nothing was changed; wait a few seconds and try again."
    assert db.scalar(text("select count(*) from sign_in_attempt")) == 0
    service.confirm_password(ada, PASSWORD)


def test_pages_that_ask_for_a_password_go_through_it(ada: int, db: Session, service_app: Any, at_once: list[int]) -> None:
    cookie = service.sign_in(db, ADA, PASSWORD)
    db.commit()
    at_once.clear()
    page = TestClient(service_app, cookies={COOKIE: cookie}, headers={"Sec-Fetch-Site": "same-origin"}, follow_redirects=False)
    sent: list[tuple[str, dict[str, str]]] = [
        ("/account/second-factor", {"present": PASSWORD}),
        *(("/accounts", {"email": f"new{i}@clinic.example", "role": "viewer", "password": NEW}) for i in range(3)),
        (f"/accounts/{ada}/password", {"password": ""}),
    ]
    answers = in_threads([lambda to=to, form=form: page.post(to, data=form).status_code for to, form in sent])  # type: ignore[misc]
    assert answers == [303, 303, 303, 303, 422]
    assert len(at_once) == 4
    assert max(at_once) == 2
