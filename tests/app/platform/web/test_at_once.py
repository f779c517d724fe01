"""Two requests at the same moment, a double click or two people: one is carried out, the other is refused in words."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from typing import Any

import pytest
from fastapi.testclient import TestClient
from structlog.testing import capture_logs

from app.accounts import repository as accounts
from app.accounts import studies
from app.study import repository as study

AT_ONCE = 4
PAGE = {"accept": "text/html"}


@pytest.fixture
def together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every request has looked whether the thing is there before any of them makes it."""
    for module, name in ((study, "visit_by_number"), (studies, "study_by_code"), (accounts, "site_by_code")):
        gate, look = Barrier(AT_ONCE, timeout=20), getattr(module, name)

        def waiting(*arguments: Any, gate: Barrier = gate, look: Any = look) -> Any:
            found = look(*arguments)
            gate.wait()
            return found

        monkeypatch.setattr(module, name, waiting)


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/participants/P1/visits", {"number": 7}),
        ("/studies", {"code": "ADAPT", "name": "Adaptive"}),
        ("/studies/main/sites", {"code": "south", "name": "South"}),
    ],
)
def test_what_is_sent_twice_at_once_is_made_once(
    client: TestClient, participant_code: str, together: None, path: str, body: dict[str, Any]
) -> None:
    with capture_logs() as logs, ThreadPoolExecutor(AT_ONCE) as pool:
        answers = list(pool.map(lambda _: client.post(f"/api/v1{path}", json=body), range(AT_ONCE)))
    assert sorted(a.status_code for a in answers) == [201] + [409] * (AT_ONCE - 1), [a.text for a in answers]
    refused = next(a for a in answers if a.status_code == 409).json()
    assert "at the same moment" in refused["detail"]
    assert "Look at what is stored" in refused["hint"]
    told = [line for line in logs if line["event"] == "two requests at the same moment"]
    assert {line["sqlstate"] for line in told} == {"23505"}
    assert "ADAPT" not in str(logs), "values stay out of logs"


def test_a_page_answers_as_the_interface_does(client: TestClient, participant_code: str, together: None) -> None:
    typed = {"number": "7", "date": "2026-04-02", "note": "tired today"}
    with ThreadPoolExecutor(AT_ONCE) as pool:
        answers = list(pool.map(lambda _: client.post("/participants/P1/visits", data=typed, headers=PAGE), range(AT_ONCE)))
    refused = [a for a in answers if a.status_code == 409]
    assert len(refused) == AT_ONCE - 1
    assert "at the same moment" in refused[0].text
    assert "tired today" in refused[0].text, "what was typed is not lost"
