"""Security headers of every answer."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from app.settings import get_settings


@pytest.mark.parametrize("path", ["/sign-in", "/static/app.css", "/api/v1/participants", "/no/such/page"])
@pytest.mark.parametrize("behind_tls", [True, False])
def test_every_answer_has_them(client: TestClient, monkeypatch: pytest.MonkeyPatch, path: str, behind_tls: bool) -> None:
    monkeypatch.setattr(get_settings(), "cookie_secure", behind_tls)
    headers = client.get(path).headers
    assert headers["x-content-type-options"] == "nosniff"
    assert "default-src 'self'" in headers["content-security-policy"]
    assert headers["x-request-id"]
    assert headers.get("strict-transport-security") == ("max-age=31536000" if behind_tls else None)
