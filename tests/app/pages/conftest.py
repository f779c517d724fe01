"""A signed-in browser without JavaScript: what a page sends is what its forms hold."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient

from app.accounts import service
from app.accounts.models import Role
from app.platform.database import transaction

PASSWORD = "correct horse battery"
HTML = {"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}


@pytest.fixture
def anonymous(service_app) -> TestClient:  # type: ignore[no-untyped-def]
    """A browser that nobody has signed in with; redirects are seen, not followed."""
    return TestClient(service_app, headers=HTML, follow_redirects=False)


@pytest.fixture
def sign_in(service_app) -> Callable[[str], TestClient]:  # type: ignore[no-untyped-def]
    """Make a user of a role and sign in through the form."""

    def make(role: str) -> TestClient:
        with transaction("test") as db:
            service.add_user(db, f"{role}-page@clinic.example", Role(role), PASSWORD)
        browser = TestClient(service_app, headers=HTML, follow_redirects=False)
        answer = browser.post("/sign-in", data={"email": f"{role}-page@clinic.example", "password": PASSWORD})
        assert answer.status_code == 303
        return browser

    return make


@pytest.fixture
def browser(sign_in: Callable[[str], TestClient]) -> TestClient:
    """A signed-in administrator."""
    return sign_in("admin")


@pytest.fixture
def table() -> bytes:
    """A table of 40 steps after a full window; steps 11-13 have no beta, step 20 stands above the cDBS amplitude."""
    lines = ["t_s,beta,amplitude_fraction"]
    for i in range(-9, 41):
        beta = "" if 11 <= i <= 13 else f"{1 + 0.5 * (i % 3):.2f}"
        lines.append(f"{2 * i},{beta},{1.2 if i == 20 else 0.5}")
    return "\n".join(lines).encode()


@pytest.fixture
def session_id(client: TestClient, enrolled: str, table: bytes) -> int:
    """A session of participant P1, visit 1, uploaded through the REST interface."""
    answer = client.post(
        "/api/v1/uploads", data={"participant": enrolled, "visit": "1", "controller": "cdbs"}, files={"file": ("one.csv", table)}
    )
    assert answer.status_code == 201, answer.text
    return int(answer.json()["sessions"][0]["id"])
