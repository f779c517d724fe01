"""Bodies that no client should send, to every operation that takes one: answered as the document says, and not even read without a
sign-in.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from app.platform.web import request_bodies as json_members
from tests.app.every_route import World

JSON, FILES, FORM = "application/json", "multipart/form-data", "application/x-www-form-urlencoded"
BODIES: dict[str, tuple[str, bytes]] = {
    "not UTF-8": (JSON, b'{"reason": "\xff\xfe"}'),
    "nested too deep": (JSON, b"[" * 60_000),
    "a number of 5 000 digits": (JSON, b'{"number": ' + b"9" * 5_000 + b"}"),
    "a member stated twice": (JSON, b'{"reason": "a", "reason": "b"}'),
    "null": (JSON, b"null"),
    "no text and no number": (JSON, b'{"reason": "\\ud800", "number": -Infinity}'),
    "a form": (FORM, b"reason=a"),
    "parts without a boundary": (FILES, b"--x\r\n"),
    "parts that never end": (f"{FILES}; boundary=x", b"--x\r\nContent-Disposition: form-data; name=file; filename=a.csv\r\n\r\nt_s"),
    "parts without names": (f"{FILES}; boundary=x", b"--x\r\nContent-Type: a/b\r\n\r\nt_s\r\n--x--\r\n"),
}
UNREADABLE = {"not UTF-8", "nested too deep", "a number of 5 000 digits"}


def with_a_body(app: FastAPI) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """List method, path and description of every operation that takes a body."""
    for path, operations in app.openapi()["paths"].items():
        for method, operation in operations.items():
            if "requestBody" in operation:
                yield method, path, operation


def sent(client: TestClient, method: str, address: str, what: str) -> int:
    """Send a malformed request; return its status."""
    kind, body = BODIES[what]
    return client.request(method, address, content=body, headers={"Content-Type": kind}).status_code


def test_every_malformed_body_is_answered_as_described(world: World) -> None:
    undocumented, read = {}, {}
    tried = 0
    for method, path, operation in with_a_body(world.app):
        address = path.format(**world.ids_of(method, path))
        takes_json = JSON in operation["requestBody"]["content"]
        for what in [w for w, (kind, _) in BODIES.items() if not (takes_json and kind.startswith(FILES))]:
            status = sent(world.admin, method, address, what)
            tried += 1
            if str(status) not in operation["responses"]:
                undocumented[method, path, what] = status
            if what in UNREADABLE and takes_json and status != 400:
                read[method, path, what] = status
    assert tried > 300
    assert undocumented == {}
    assert read == {}


def test_no_body_of_nobody_is_read(service_app: FastAPI, fresh_database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Callers without a sign-in are refused, whatever they send to the interface, and nothing looks into it."""
    looked: list[bytes] = []
    monkeypatch.setattr(json_members, "doubled_member", looked.append)
    ids = dict.fromkeys(("code", "study_code", "site_code"), "P1")
    wrong = {}
    for credential in ({}, {"Authorization": "Bearer blp_of_nobody"}, {"Cookie": "betaloop_session=of-nobody"}):
        nobody = TestClient(service_app, headers=credential)
        for method, path, operation in with_a_body(service_app):
            numbers = {p["name"]: "1" for p in operation.get("parameters", []) if p["in"] == "path"}
            for what in BODIES if not credential else ("not UTF-8", "parts that never end"):
                status = sent(nobody, method, path.format(**numbers | ids), what)
                if status != 401:
                    wrong[method, path, what, *credential] = status
    assert wrong == {}
    assert looked == []


def test_json_of_nobody_is_read_by_no_page_either(service_app: FastAPI, fresh_database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[bytes] = []
    monkeypatch.setattr(json_members, "doubled_member", looked.append)
    nobody = TestClient(service_app)
    for address in ("/sign-in", "/participants/P1/visits", "/no/such/page"):
        assert [sent(nobody, "post", address, what) for what, (kind, _) in BODIES.items() if kind == JSON] == [401] * 6, address
    assert looked == []
    assert nobody.post("/sign-in", data={"email": "a@b.example", "password": "wrong"}).status_code == 401, "a form of a page is read"


def test_every_operation_that_writes_says_when_it_is_sent_too_much(world: World) -> None:
    large = b" " * ((1 << 20) + 1)
    for method, path, operation in with_a_body(world.app):
        answer = world.admin.request(method, path.format(**world.ids_of(method, path)), content=large, headers={"Content-Type": JSON})
        assert (answer.status_code, "413" in operation["responses"]) == (413, True), (method, path)


def test_answers_that_stand_before_every_route_are_described(service_app: FastAPI) -> None:
    """Those that the database and the disk give, whichever route it is; `test_healing.py` meets them."""
    for path, operations in service_app.openapi()["paths"].items():
        for method, operation in operations.items():
            own = {"503"} if path in ("/healthz", "/readyz") else {"503", "507"}
            wanted = own | ({"413", "429"} if method != "get" else set()) | ({"400"} if "requestBody" in operation else set())
            assert wanted <= operation["responses"].keys(), (method, path)
            for status in wanted:
                assert operation["responses"][status]["content"].keys() == {"application/problem+json"}, (method, path, status)
