"""Every page and every form against every role, of this study, of another one and of another site; allowed and refused alike."""

from __future__ import annotations

import re
import time
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text

from app.accounts import repository, second_factor
from app.accounts.permissions import PERMISSIONS
from app.platform.database import new_session, transaction
from app.settings import get_settings
from app.tables.accounts import Role, Site, Study
from tests.app.every_route import PASSWORD, World
from tests.app.pages import page_roles as roles
from tests.app.pages.every_page import ELSEWHERE, addresses, routes
from tests.app.pages.page_calls import NEW, browser, calls, posts

SHARED = {"/", "/account", "/glossary", "/api-reference", "/styleguide", "/search", "/jobs", "/analyses",
          "/adverse-events", "/analyses/figure", "/analyses/results.csv", "/analyses/results.svg", "/trial-time", "/energy-saved",
          "/studies", "/accounts", "/audit",
          "/audit.csv",
          "/participants/new", "/visit-day/key", *roles.WITHOUT_SIGN_IN}  # fmt: skip
"""Pages without an object in their address: each user sees what they may of it."""
IDLE = {"/participants/{code}/next-generation", "/sessions/{session_id}/markers"}
"""Forms with nothing to do in this study, without a policy to train further and without markers: they refuse with that reason."""


@pytest.fixture(autouse=True)
def _development(world: World) -> None:
    get_settings().development = True  # the style guide is a page then


def may_open(role: Role, path: str) -> bool:
    if path in roles.WITHOUT_SIGN_IN:
        return True
    if role is Role.BLINDED_ASSESSOR:
        return path in roles.BLINDED_PAGES
    return roles.PAGES[path] in PERMISSIONS[role]


def may_send(role: Role, path: str) -> bool:
    if role is Role.BLINDED_ASSESSOR:
        return path in roles.BLINDED_FORMS
    return roles.FORMS[path] in PERMISSIONS[role]


def opened(client: TestClient, path: str) -> int:
    with client.stream("get", path) as answer:
        return int(answer.status_code)


def sent(client: TestClient, path: str, call: dict[str, Any], ids: dict[str, Any]) -> int:
    named = ids | {name: value for name, value in call.items() if name not in ("data", "files")}
    return int(client.post(path.format(**named), data=call.get("data"), files=call.get("files")).status_code)


def written() -> int:
    """Count changes of rows so far; looks and refusals are none."""
    with new_session() as db:
        return int(db.scalar(text("select count(*) from audit_event where action in ('insert', 'update', 'delete')")) or 0)


def test_every_page_and_every_form_is_in_the_table(world: World) -> None:
    named = {*roles.FORMS, *roles.OWN_FORMS, *roles.BEFORE_SIGN_IN}
    assert {path for _, path in posts(world.app)} == named, "say in page_roles.py who may send it"
    assert {method for method, _ in posts(world.app)} == {"post"}
    assert set(calls(world)) == set(roles.FORMS), "say in page_calls.py what a right call sends"
    without_page = set(ELSEWHERE) - roles.WITHOUT_SIGN_IN
    assert {*roles.PAGES, *roles.WITHOUT_SIGN_IN} == set(routes(world.app)) - without_page, "say in page_roles.py who may open it"
    assert roles.PAGES.keys().isdisjoint(roles.WITHOUT_SIGN_IN)
    assert roles.PAGES.keys() >= roles.BLINDED_PAGES


@pytest.mark.parametrize("role", list(Role))
def test_every_page_against_every_role(world: World, role: Role) -> None:
    client, found = browser(world.app, role), {}
    for path, address in addresses(world).items():
        status = opened(client, address)
        right = (200, 303) if may_open(role, path) else (403, 404) if role is Role.BLINDED_ASSESSOR else (403,)
        if status not in right:
            found[path] = f"{status}, not {right[0]}"
    assert found == {}


@pytest.mark.parametrize("role", list(Role))
def test_every_form_against_every_role(world: World, role: Role) -> None:
    """A form that may be sent does what it says; one that may not is refused, and writes nothing."""
    client, wanted, found = browser(world.app, role), calls(world), {}
    for path in roles.FORMS:
        before = written()
        status, may = sent(client, path, wanted[path], world.ids), may_send(role, path)
        right = (422,) if may and path in IDLE else (200, 303) if may else (403,)
        if status not in right or (written() > before) is not (may and path not in IDLE):
            found[path] = f"{status} and {written() - before} rows, {'may' if may else 'may not'}"
    assert found == {}


def test_nobody_who_has_not_signed_in_opens_or_sends_anything(world: World) -> None:
    client, before = TestClient(world.app, headers={"Accept": "text/html"}, follow_redirects=False), written()
    found: dict[str, Any] = {}
    for path, address in addresses(world).items():
        answer = client.get(address)
        inside = path not in roles.WITHOUT_SIGN_IN and not answer.headers.get("location", "").startswith("/sign-in")
        if inside and answer.status_code != 401:
            found[path] = answer.status_code
    for path, call in calls(world).items():
        if (status := sent(client, path, call, world.ids)) != 401:
            found[path] = status
    assert found == {}
    assert written() == before


@pytest.mark.parametrize("where", ["study", "site"])
def test_an_administrator_of_another_study_or_site_sees_and_changes_nothing(world: World, where: str) -> None:
    with transaction("test") as db:
        study = Study(code="other", name="Other study") if where == "study" else db.query(Study).filter_by(code="main").one()
        db.add(study)
        db.flush()
        site = Site(study_id=study.id, code="elsewhere", name="Another clinic")
        db.add(site)
        db.flush()
        number, code = (None, "other") if where == "study" else (site.id, None)
    client, found = browser(world.app, "admin", code, number), {}
    own = set(SHARED) if where == "study" else SHARED | {"/studies/{study_code}/column-mappings"}
    for path, address in addresses(world).items():
        answer = client.get(address)
        if path in own:
            told = re.findall(r"/participants/P[1-4]\b|[\w.-]+@clinic\.example", answer.text.replace("admin-browser@clinic.example", ""))
            if path == "/studies/{study_code}/column-mappings":
                told = []  # they are the whole study's, and say who made them
            if answer.status_code not in (200, 303) or told:
                found[path] = f"{answer.status_code}, {told[:3]}"
        elif answer.status_code != 404:
            found[path] = f"{answer.status_code}, not 404"
    before = written()
    of_all = {"/studies", "/accounts", "/participants"}
    for path, call in calls(world).items():
        status = sent(client, path, call, world.ids)
        of_study = path in of_all or (where == "site" and path.startswith(("/studies/", "/column-mappings/")))
        if status not in ((403, 404, 422) if of_study else (404,)):
            found[f"post {path}"] = status
        if written() > before:
            found[f"post {path}"], before = "something was written", written()
    assert found == {}


@pytest.mark.parametrize("role", [Role.BLINDED_ASSESSOR, Role.VIEWER, Role.ADMIN])
def test_ones_own_access_is_open_to_every_role(world: World, role: Role) -> None:
    client = browser(world.app, role)
    with new_session() as db:
        user = repository.user_by_email(db, f"{role}-browser@clinic.example")
        assert user is not None
    answers = [client.post("/account/tokens", data={"name": "tablet"}).status_code]
    with new_session() as db:
        (token,) = repository.tokens_of(db, user.id)
    answers += [client.post(f"/account/tokens/{token.id}/revoke").status_code]
    answers += [client.post("/account/second-factor", data={"present": PASSWORD}).status_code]
    with new_session() as db:
        secret = second_factor.pending_secret(db, user.id)
        assert secret is not None
    step = second_factor.step_at(time.time())
    answers += [client.post("/account/second-factor/confirm", data={"code": second_factor.code_of(secret, step)}).status_code]
    again = {"present": PASSWORD, "code": second_factor.code_of(secret, step + 1)}
    answers += [client.post("/account/second-factor/remove", data=again).status_code]
    answers += [client.post("/account/password", data={"present": PASSWORD, "password": NEW, "again": NEW}).status_code]
    answers += [client.post("/sign-out").status_code]
    assert dict(zip(roles.OWN_FORMS, answers, strict=True)) == dict(zip(roles.OWN_FORMS, (200, 303, 303, 200, 303, 303, 303), strict=True))
