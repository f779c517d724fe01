"""Sentences are for people: other words change no decision."""

from __future__ import annotations

import io

import pytest
from fastapi.testclient import TestClient

from app.ingest import wording as ingest_wording
from app.study.sessions import wording
from app.study.sessions.contradictions import Kind

TWO_SIDES = {"visit": "", "confirm": "false"}


def steps(amplitude: float) -> bytes:
    lines = ["t_s,beta,amplitude_ma", *(f"{2 * (i + 1)},{1 + i % 3},{amplitude}" for i in range(30))]
    return "\n".join(lines).encode()


def run(client: TestClient, participant: str) -> list[object]:
    """Collect everything that is decided on proposals of three uploads: controller, visit open, versions, refusals."""
    client.post(f"/api/v1/participants/{participant}/visits", json={"number": 1, "date": "2026-03-02"})
    decided: list[object] = []
    for amplitude, stated in ((0.0, {}), (1.5, {}), (2.0, {"controller": "random"})):
        form = {"participant": participant, "confirm": "false", **stated}
        answer = client.post("/api/v1/uploads", data=form, files={"file": ("a.csv", io.BytesIO(steps(amplitude)))}).json()
        for p in answer["proposals"]:
            url = f"/api/v1/proposals/{p['session']['id']}"
            # a correction of the part makes a guessed controller be guessed again, and leaves a stated one alone
            moved = client.patch(url, json={"version": p["version"], "stop_s": 40}).json()
            named = client.patch(url, json={"version": moved["version"], "controller": "cdbs"}).json()
            again = client.patch(url, json={"version": named["version"], "stop_s": 30}).json()
            refused = client.post(f"{url}/confirm", json={"version": again["version"]})
            decided.append((p["session"]["controller"], moved["session"]["controller"], again["session"]["controller"]))
            decided.append((p["visit_open"], again["version"], refused.status_code))
    return decided


def test_other_words_change_no_decision(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    def enrol(code: str) -> str:
        answer = client.post("/api/v1/participants", json={"code": code, "settings": {"cdbs_amplitude_ma": 3.0}})
        assert answer.status_code == 201, answer.text
        return code

    plain = run(client, enrol("P8"))
    assert plain[0] == ("no_dbs", "no_dbs", "cdbs")
    assert plain[4] == ("random", "random", "cdbs")
    monkeypatch.setattr(ingest_wording, "reason", lambda evidence: "reworded")
    monkeypatch.setattr(ingest_wording, "unreadable", lambda members: ["reworded" for _ in members])
    for kind in Kind:
        monkeypatch.setitem(wording._SENTENCES, kind, lambda facts: "reworded")
    assert run(client, enrol("P9")) == plain


def test_every_contradiction_has_words() -> None:
    assert set(wording._SENTENCES) == set(Kind)
