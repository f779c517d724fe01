"""A withdrawn participant is marked on their pages, and in lists next to the code."""

from __future__ import annotations

import re

import pytest
from sqlalchemy import text

from app.platform.database import new_session, transaction
from app.settings import get_settings
from tests.app.every_route import World
from tests.app.pages.every_page import addresses
from tests.app.pages.page_calls import browser

LISTS = {"/?withdrawn=yes", "/jobs", "/analyses", "/trial-time", "/energy-saved"}


@pytest.fixture
def withdrawn(world: World) -> World:
    """The study after everybody has withdrawn."""
    get_settings().development = True
    with transaction("test") as db:
        db.execute(text("update participant set status = 'withdrawn'"))
    return world


def codes() -> list[str]:
    with new_session() as db:
        return list(db.scalars(text("select code from participant")))


def test_every_page_of_a_participant_who_has_withdrawn_says_so(withdrawn: World) -> None:
    client, seen, silent = browser(withdrawn.app, "admin"), 0, []
    for path, address in addresses(withdrawn).items():
        if "{" not in path or "{study_code}" in path:
            continue
        with client.stream("get", address) as answer:
            if answer.status_code != 200 or not answer.headers["content-type"].startswith("text/html"):
                continue
            page = answer.read().decode()
        seen += 1
        if not re.search(r"P\d has withdrawn from the study", page):
            silent.append((path, address))
    assert silent == []
    assert seen > 30


def test_who_takes_part_is_not_marked(world: World) -> None:
    client = browser(world.app, "admin")
    assert "has withdrawn" not in client.get("/participants/P1").text


def test_lists_mark_who_has_withdrawn(withdrawn: World) -> None:
    client = browser(withdrawn.app, "admin")
    bare = [address for address in LISTS if '<span class="badge warn">withdrawn</span>' not in client.get(address).text]
    assert bare == []
    assert "P1 (withdrawn)" in client.get("/search?q=rl").text
