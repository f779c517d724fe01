"""A system user of a test's own: made by what is tested, removed afterwards, and never one that others run under."""

from __future__ import annotations

import os
import pwd
import secrets
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

FRESH_MACHINE = "BETALOOP_TEST_FRESH_MACHINE"


def require_root(reason: str) -> None:
    """Skip where the test cannot make users; where the run claims to be a fresh machine (`.ci/run`) fail instead."""
    if os.geteuid() != 0:
        if os.environ.get(FRESH_MACHINE):
            pytest.fail(f"{reason}, and {FRESH_MACHINE} is set: run as root")
        pytest.skip(reason)


@contextmanager
def unknown_user() -> Iterator[str]:
    """Yield a name that no user has; the user of that name, if one was made meanwhile, is removed at the end."""
    name = f"bltest-{secrets.token_hex(6)}"
    assert not exists(name)
    try:
        yield name
    finally:
        if exists(name):
            subprocess.run(["userdel", name], check=True, capture_output=True)


def exists(name: str) -> bool:
    """Check whether there is a user of this name."""
    try:
        pwd.getpwnam(name)
    except KeyError:
        return False
    return True
