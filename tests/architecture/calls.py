"""Modules that a call enters: those of `app` and `ml` whose functions run during it, in its thread and in threads begun by it.

What every request passes is left away: `app.platform`, `app.accounts` and `app.settings`. So are templates. Tables count as
one module: they define rows.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from inspect import CO_OPTIMIZED
from types import CodeType, FrameType
from typing import Any

from tests.architecture.texts import ROOT

EVERY_REQUEST = ("app.platform.", "app.accounts.", "app.settings")
TABLES = "app.tables"


@contextmanager
def modules_entered() -> Iterator[set[str]]:
    """Collect the modules whose functions are called; the set is filled at the end."""
    called: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            called.add(frame.f_code)

    modules: set[str] = set()
    threading.setprofile(note)
    sys.setprofile(note)
    try:
        yield modules
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
        modules.update(filter(None, map(module_of, called)))


def module_of(code: CodeType) -> str | None:
    """Name the module of a function; None for what is no step of a call. The body of a module or class that is loaded is none."""
    path = code.co_filename.removeprefix(f"{ROOT}/")
    if not code.co_flags & CO_OPTIMIZED or not path.startswith(("app/", "ml/")) or not path.endswith(".py"):
        return None
    name = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    return None if name.startswith(EVERY_REQUEST) else TABLES if name.startswith(TABLES) else name
