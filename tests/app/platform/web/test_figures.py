"""Access to the figures of the service and the description of its interface."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts import service
from app.settings import get_settings
from app.tables.accounts import Role, Scope
from tests.conftest import PASSWORD

FIGURES, DESCRIPTION = "/metrics", "/api/v1/openapi.json"


@pytest.fixture
def calling(service_app: Any, db: Session) -> Callable[..., TestClient]:
    """Clients by the scope of a token of Ada's; without one a stranger."""
    service.add_user(db, "ada@clinic.example", Role.ADMIN, PASSWORD)
    db.commit()

    def client(scope: Scope | None = None, address: str = "192.0.2.7", **more: str) -> TestClient:
        headers = dict(more)
        if scope is not None:
            headers["Authorization"] = f"Bearer {service.create_token(db, 'ada@clinic.example', scope.value, scope)}"
            db.commit()
        return TestClient(service_app, headers=headers, client=(address, 50_000))

    return client


def test_a_stranger_reads_neither(calling: Callable[..., TestClient]) -> None:
    for address in ("192.0.2.7", "127.0.0.1"):
        stranger = calling(address=address)
        for path in (FIGURES, DESCRIPTION):
            answer = stranger.get(path)
            assert (answer.status_code, "betaloop_requests_total" in answer.text, "paths" in answer.text) == (401, False, False), path
        assert stranger.get("/healthz").status_code == 200


def test_a_token_for_figures_reads_them_and_nothing_else(calling: Callable[..., TestClient]) -> None:
    monitor = calling(Scope.METRICS)
    answer = monitor.get(FIGURES)
    assert (answer.status_code, "betaloop_requests_total" in answer.text) == (200, True)
    for path in (DESCRIPTION, "/api/v1/participants", "/api/v1/studies", "/api/v1/bundle-key", "/"):
        refused = monitor.get(path)
        assert (refused.status_code, "and nothing else" in refused.text) == (403, True), path


@pytest.mark.parametrize("scope", [Scope.READ, Scope.FULL])
def test_who_may_read_reads_both(calling: Callable[..., TestClient], scope: Scope) -> None:
    reader = calling(scope)
    assert reader.get(FIGURES).status_code == 200
    assert "/api/v1/participants" in reader.get(DESCRIPTION).json()["paths"]


def test_programs_of_this_machine_read_the_figures_where_the_installation_says_so(
    calling: Callable[..., TestClient], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BETALOOP_METRICS_ON_LOOPBACK", "true")
    get_settings.cache_clear()
    assert [calling(address=a).get(FIGURES).status_code for a in ("127.0.0.1", "::1", "192.0.2.7")] == [200, 200, 401]
    assert calling(address="127.0.0.1").get(DESCRIPTION).status_code == 401
    passed_on = {"X-Forwarded-For": "192.0.2.7"}
    assert calling(address="127.0.0.1", **passed_on).get(FIGURES).status_code == 401, "a proxy of this machine hands strangers on"
