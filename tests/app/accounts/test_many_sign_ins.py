"""Many sign-ins at once: passwords are checked a few at a time, and the rest of the service goes on answering."""

from __future__ import annotations

import asyncio
import sys
import threading
import time

import httpx2 as httpx
import pytest

from app.accounts import pages, service
from app.platform.errors import Unauthorized

MANY = 60
CHECK_S = 0.05


@pytest.fixture
def slow_checks(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Password checks that take CHECK_S and note how many run at the same time."""
    running, at_once, lock = [0], [], threading.Lock()

    def check(*_: object) -> str:
        with lock:
            running[0] += 1
            at_once.append(running[0])
        time.sleep(CHECK_S)
        with lock:
            running[0] -= 1
        raise Unauthorized("The e-mail address or the password is wrong.")

    monkeypatch.setattr(service, "sign_in", check)
    return at_once


async def _all_at_once(service_app: object, answers: list[int], checked_before_static: list[int]) -> None:
    transport = httpx.ASGITransport(app=service_app)  # type: ignore[arg-type]
    async with httpx.AsyncClient(transport=transport, base_url="http://testserver") as client:

        async def sign_in() -> None:
            answers.append((await client.post("/sign-in", data={"email": "x@y.example", "password": "wrong"})).status_code)

        async def read_static() -> None:
            await asyncio.sleep(4 * CHECK_S)
            assert (await client.get("/static/app.css")).status_code == 200
            checked_before_static.append(len(answers))

        await asyncio.gather(*(sign_in() for _ in range(MANY)), read_static())


def test_static_files_do_not_wait_for_passwords(service_app: object, slow_checks: list[int]) -> None:
    answers: list[int] = []
    checked_before_static: list[int] = []
    asyncio.run(_all_at_once(service_app, answers, checked_before_static))
    assert answers == [401] * MANY
    assert max(slow_checks) <= 2
    assert checked_before_static[0] < MANY / 2, "far before the last of them was checked"


def test_more_than_can_wait_are_asked_to_come_back(service_app: object, slow_checks: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages._passwords, "most", 7)
    monkeypatch.setattr(sys.modules[__name__], "CHECK_S", 0.5)
    answers: list[int] = []
    asyncio.run(_all_at_once(service_app, answers, []))
    assert set(answers) == {401, 429}
    assert max(slow_checks) <= 2
