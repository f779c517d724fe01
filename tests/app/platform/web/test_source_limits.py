"""Limits of requests from one source; nothing large is received without a sign-in."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import uvicorn
from fastapi.testclient import TestClient

from app.platform.web.sources import MOST_SOURCES, Allowance, in_words
from app.settings import get_settings
from tests.app.every_route import TABLE
from tests.conftest import PASSWORD

GIB = 1 << 30
MOST_RECEIVED = 32 << 20
"""Bytes that the buffers of two sockets may hold, generously."""


class Clock:
    """Seconds that a test sets."""

    present = 0.0

    def __call__(self) -> float:
        return self.present


def test_an_allowance_is_used_up_and_comes_back_evenly() -> None:
    clock = Clock()
    allowance = Allowance(lambda: 10.0, 100.0, clock)
    assert [allowance.take("a", 4.0) for _ in range(3)] == [0, 0, 20]
    assert allowance.take("b", 10.0) == 0, "each source has its own"
    clock.present = 19.9
    assert allowance.take("a", 4.0) == 1
    clock.present = 20.0
    assert allowance.take("a", 4.0) == 0
    allowance.give_back("a", 4.0)
    assert allowance.take("a", 4.0) == 0
    clock.present = 2000.0
    assert allowance.take("a", 25.0) == 0, "more than it ever has, to one that has used up nothing"
    assert allowance.take("a", 1.0) == 160


def test_no_number_of_sources_fills_the_memory() -> None:
    allowance = Allowance(lambda: 10.0, 100.0, Clock())
    allowance.take("most", 10.0)
    for i in range(3 * MOST_SOURCES):
        allowance.take(f"source {i}", 1.0)
    assert len(allowance._used) <= MOST_SOURCES
    assert allowance.take("most", 1.0) > 0, "who has used up most is remembered longest"


def test_a_wait_is_said_in_words() -> None:
    assert (in_words(45), in_words(91), in_words(900)) == ("45 seconds", "2 minutes", "15 minutes")


def test_many_accounts_tried_from_one_address_are_refused_in_words(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(get_settings(), "failed_sign_ins_per_source", 6)
    right = {"email": "admin@clinic.example", "password": PASSWORD}
    page = TestClient(client.app, headers={"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}, follow_redirects=False)
    for _ in range(10):
        assert page.post("/sign-in", data=right).status_code == 303, "what was right is not counted"
    tried = [page.post("/sign-in", data={"email": f"user{i}@clinic.example", "password": "Password1"}) for i in range(8)]
    assert [answer.status_code for answer in tried] == [401] * 6 + [429] * 2
    assert 140 <= int(tried[-1].headers["retry-after"]) <= 150
    assert "Too many failed sign-ins came from here." in tried[-1].text
    assert "Wait 3 minutes and try again." in tried[-1].text
    assert page.post("/sign-in", data=right).status_code == 429


def test_a_locked_account_says_when_to_come_back(client: TestClient) -> None:
    page = TestClient(client.app, headers={"Sec-Fetch-Site": "same-origin"})
    answers = [page.post("/sign-in", data={"email": "admin@clinic.example", "password": "wrong"}) for _ in range(6)]
    assert (answers[-1].status_code, answers[-1].headers["retry-after"]) == (429, "900")


def test_files_beyond_what_a_source_may_send_are_refused_in_words(
    client: TestClient, participant_code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    large = TABLE + b"".join(b"%d,1.0%06d,1\n" % (2 * k, k) for k in range(21, 6000))
    stated = {"participant": "P1", "visit": "1", "controller": "random"}
    assert client.post("/api/v1/uploads", data=stated, files={"file": ("s.csv", large)}).status_code == 201
    monkeypatch.setattr(get_settings(), "upload_gib_per_hour", 1.5 * len(large) / GIB)
    answer = client.post("/api/v1/uploads", data=stated, files={"file": ("t.csv", large.replace(b"42,", b"42,0", 1))})
    assert answer.status_code == 429
    assert answer.json()["detail"].endswith("GiB of files came from here within an hour.")
    assert answer.json()["hint"].startswith("Wait ")
    assert int(answer.headers["retry-after"]) > 60
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert client.get("/api/v1/participants").status_code == 200, "everything else goes on"


@pytest.fixture
def port(service_app: Any) -> Iterator[int]:
    """The service on a real socket."""
    server = uvicorn.Server(uvicorn.Config(service_app, host="127.0.0.1", port=0, log_level="error", lifespan="off"))
    thread = threading.Thread(target=server.run)
    thread.start()
    deadline = time.monotonic() + 300
    while not server.started:
        assert time.monotonic() < deadline, "the service did not start"
        time.sleep(0.01)
    yield int(server.servers[0].sockets[0].getsockname()[1])
    server.should_exit = True
    thread.join(30)


def sent_in_vain(port: int, head: str, chunked: bool) -> tuple[int, int]:
    """Send a request with a body without end; return its status, and how many bytes were sent until the service hung up."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as line:
        line.sendall(head.encode())
        status = int(line.recv(1 << 16).split()[1])
        chunk = bytes(1 << 20)
        part, went = (b"%x\r\n%s\r\n" % (len(chunk), chunk) if chunked else chunk), 0
        try:
            while went < 4 * MOST_RECEIVED:
                went += line.send(part)
        except OSError:
            pass  # the service has hung up, as it should
        return status, went


FILES, JSON = "multipart/form-data; boundary=x", "application/json"
PATHS = [
    ("/api/v1/uploads", FILES),
    ("/api/v1/participants/P1/policies", FILES),
    ("/sign-in", FILES),
    ("/participants/P1/upload", FILES),
    ("/api/v1/participants", JSON),
    ("/no/such/page", FILES),
]
NOBODY = ["", "Authorization: Bearer blp_of_nobody\r\n", "Cookie: betaloop_session=of-nobody\r\n"]


@pytest.mark.parametrize("length", ["Content-Length: 1073741824", "Transfer-Encoding: chunked"])
def test_a_gibibyte_of_nobody_is_refused_before_it_is_received(port: int, length: str) -> None:
    for (path, kind), credential in itertools.product(PATHS, NOBODY):
        head = f"POST {path} HTTP/1.1\r\nHost: h\r\nContent-Type: {kind}\r\n{credential}{length}\r\n\r\n"
        status, went = sent_in_vain(port, head, "chunked" in length)
        too_large = kind == JSON and "Content-Length" in length
        assert status == (413 if too_large else 401), (path, credential)
        assert went < MOST_RECEIVED, (path, credential)
