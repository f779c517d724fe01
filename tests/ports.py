"""Ports for services that tests start in processes of their own."""

from __future__ import annotations

import random
import socket

BELOW_OUTGOING = range(20_000, 32_000)
"""Ports that no system gives to outgoing connections, of which every other test makes many between the choice of a port and its use."""


def free_port() -> int:
    """Find a port of this machine that nothing listens on; two workers do not choose the same one."""
    for port in random.SystemRandom().sample(BELOW_OUTGOING, 100):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise AssertionError("a hundred ports are taken")
