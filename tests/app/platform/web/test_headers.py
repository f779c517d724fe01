"""Security headers of every answer."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from app.cli import decide_cookies
from app.settings import Settings, get_settings


@pytest.mark.parametrize("path", ["/sign-in", "/static/app.css", "/api/v1/participants", "/no/such/page"])
@pytest.mark.parametrize("behind_tls", [True, False])
def test_every_answer_has_them(client: TestClient, monkeypatch: pytest.MonkeyPatch, path: str, behind_tls: bool) -> None:
    monkeypatch.setattr(get_settings(), "cookie_secure", behind_tls)
    headers = client.get(path).headers
    assert headers["x-content-type-options"] == "nosniff"
    assert "default-src 'self'" in headers["content-security-policy"]
    assert headers["x-request-id"]
    assert headers.get("strict-transport-security") == ("max-age=31536000" if behind_tls else None)


@pytest.mark.parametrize(
    ("host", "tls", "stated", "secure"),
    [
        ("127.0.0.1", False, None, False),
        ("0.0.0.0", False, None, True),
        ("192.0.2.7", False, None, True),
        ("192.0.2.7", False, "false", False),
        ("192.0.2.7", False, "true", True),
        ("127.0.0.1", False, "true", True),
        ("127.0.0.1", True, None, True),
        ("192.0.2.7", True, "false", True),
    ],
)
def test_sessions_leave_the_machine_over_https_alone_unless_somebody_says_otherwise(
    monkeypatch: pytest.MonkeyPatch, host: str, tls: bool, stated: str | None, secure: bool
) -> None:
    monkeypatch.delenv("BETALOOP_COOKIE_SECURE", raising=False)
    if stated is not None:
        monkeypatch.setenv("BETALOOP_COOKIE_SECURE", stated)
    settings = Settings(_env_file=None)  # type: ignore[call-arg]
    decide_cookies(settings, host, tls=tls)
    assert settings.cookie_secure is secure


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("DELETE", "/api/v1/participants/P1", "GET, PATCH"),
        ("DELETE", "/api/v1/sessions/1/qoc", "GET, PUT"),
        ("PUT", "/api/v1/participants/P1/margins/locks", "GET, POST"),
        ("PUT", "/healthz", "GET"),
    ],
)
def test_a_wrong_method_is_told_every_right_one(client: TestClient, method: str, path: str, allowed: str) -> None:
    answer = client.request(method, path)
    assert (answer.status_code, answer.headers["allow"]) == (405, allowed)
