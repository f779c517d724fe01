"""A connection that a browser or an uploader keeps open is answered again after a pause, not reset."""

from __future__ import annotations

import http.client
import signal
import time
from pathlib import Path

import pytest

from tests.app.platform.test_stops import data as data
from tests.app.platform.test_stops import start, wait_for
from tests.ports import free_port

PAUSE_S = 8.0
"""Longer than the 5 s after which uvicorn ends a quiet connection by itself: a request on its way at that moment was reset."""


@pytest.mark.slow
def test_a_connection_outlives_a_pause(data: Path) -> None:
    port = free_port()
    service = start(data, "serve", "--port", str(port))
    try:
        wait_for(data, "running on", service)
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
        for pause_s in (0.0, PAUSE_S, 0.0):
            time.sleep(pause_s)
            connection.request("GET", "/healthz")
            socket = connection.sock
            answer = connection.getresponse()
            assert (answer.status, answer.getheader("connection")) == (200, None)
            answer.read()
            assert connection.sock is socket, "http.client opens a new one where the old was ended"
    finally:
        service.send_signal(signal.SIGTERM)
        service.wait(300)
