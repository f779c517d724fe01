"""A network connection to a server that can be cut off (connections are refused) or fall silent (nothing is refused, nothing arrives)."""

from __future__ import annotations

import signal
import subprocess
import sys

from tests.ports import free_port

FORWARD = """
import socket, sys, threading
def copy(a, b):
    try:
        while data := a.recv(65536):
            b.sendall(data)
    except OSError:
        pass
    for s in (a, b):
        try:
            s.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass
host, port, place = sys.argv[1:]
server = socket.create_server((host, int(port)))
print("ready", flush=True)
while True:
    client, _ = server.accept()
    if place.startswith("/"):
        to = socket.socket(socket.AF_UNIX)
        to.connect(place)
    else:
        to = socket.create_connection(("127.0.0.1", int(place)))
    for pair in ((client, to), (to, client)):
        threading.Thread(target=copy, args=pair, daemon=True).start()
"""
"""Program that passes connections on: address and port to listen at, and the port or the path of a socket that they lead to."""


class Line:
    """Way from a port of this machine to a server, which is another port or the path of a socket. It is a process of its own."""

    def __init__(self, place: int | str) -> None:
        self.port, self._place = free_port(), str(place)
        self.restore()

    def cut(self) -> None:
        """End every connection; new ones are refused."""
        self.process.kill()
        self.process.wait()

    def restore(self) -> None:
        """Pass connections on, again."""
        self.process = subprocess.Popen(
            [sys.executable, "-c", FORWARD, "127.0.0.1", str(self.port), self._place], stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"

    def silence(self) -> None:
        """Stop to pass anything on: no answer comes, and no error."""
        self.process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Pass everything on again."""
        self.process.send_signal(signal.SIGCONT)
