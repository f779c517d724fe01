"""A signed-in browser without JavaScript: what a page sends is what its forms hold."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from pwdlib import PasswordHash

from app.accounts import service
from app.accounts.deps import COOKIE
from app.platform.database import transaction
from app.tables.accounts import Membership, Role, SignIn, User

PASSWORD = "correct horse battery"
HTML = {"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}


@pytest.fixture
def anonymous(service_app) -> TestClient:  # type: ignore[no-untyped-def]
    """A browser without a sign-in; redirects are seen, not followed."""
    return TestClient(service_app, headers=HTML, follow_redirects=False)


@pytest.fixture(scope="session")
def password_hash() -> str:
    """The hash of PASSWORD; made once, for it is meant to be slow."""
    return PasswordHash.recommended().hash(PASSWORD)


@pytest.fixture
def sign_in(service_app, password_hash: str) -> Callable[[str], TestClient]:  # type: ignore[no-untyped-def]
    """Function that makes a user of a role with PASSWORD and an open browser session."""

    def make(role: str) -> TestClient:
        with transaction("test") as db:
            user = User(email=f"{role}-page@clinic.example", name="", password_hash=password_hash)
            user.memberships.append(Membership(study_id=service.study_of(db, None).id, role=Role(role)))
            db.add(user)
            db.flush()
            db.add(SignIn(token_sha256=hashlib.sha256(role.encode()).hexdigest(), user_id=user.id))
        return TestClient(service_app, headers=HTML, cookies={COOKIE: role}, follow_redirects=False)

    return make


@pytest.fixture
def browser(sign_in: Callable[[str], TestClient]) -> TestClient:
    """A signed-in administrator."""
    return sign_in("admin")


@pytest.fixture
def table() -> bytes:
    """A table of 40 steps after a full window; steps 11-13 have no beta, step 20 is above the cDBS amplitude."""
    lines = ["t_s,beta,amplitude_fraction"]
    for i in range(-9, 41):
        beta = "" if 11 <= i <= 13 else f"{1 + 0.5 * (i % 3):.2f}"
        lines.append(f"{2 * i},{beta},{1.2 if i == 20 else 0.5}")
    return "\n".join(lines).encode()


@pytest.fixture
def session_id(client: TestClient, participant_code: str, table: bytes) -> int:
    """A session of participant P1, visit 1, uploaded through the REST interface."""
    answer = client.post(
        "/api/v1/uploads", data={"participant": participant_code, "visit": "1", "controller": "cdbs"}, files={"file": ("one.csv", table)}
    )
    assert answer.status_code == 201, answer.text
    return int(answer.json()["sessions"][0]["id"])
