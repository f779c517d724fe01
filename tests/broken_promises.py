"""Break promises of docs/trust.md on purpose, one after another, and see that the test which shows each one fails.

    nice .venv/bin/python -m tests.broken_promises [WORD ...]     those whose sentence or test has one of the words; all by default

Ends with exit code 1 where a test did not notice. `tests/test_trust.py` looks that every line which is broken here is still there.
"""

from __future__ import annotations

import gc
import importlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from inspect import CO_OPTIMIZED
from pathlib import Path
from types import CodeType, FunctionType

import pytest
from _pytest.runner import runtestprotocol

from tests.promised.promise import Promise
from tests.promises import PROMISES

ROOT = Path(__file__).resolve().parents[1]
COPIED = (
    ".ci",
    "app",
    "ml",
    "migrations",
    "static",
    "tests",
    "benchmarks",
    "docs",
    "pyproject.toml",
    "alembic.ini",
    "docker-compose.yml",
    "Dockerfile",
    "Makefile",
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "requirements.lock",
    "requirements-service.lock",
)


def say(line: str) -> None:
    """Write a line past what pytest catches."""
    assert sys.__stdout__ is not None
    sys.__stdout__.write(line + "\n")
    sys.__stdout__.flush()


def wanted(words: list[str]) -> list[Promise]:
    """Select the promises that have one of the words; all without words."""
    return [p for p in PROMISES if not words or any(w in p.said or w in p.test or w in p.file for w in words)]


def functions(code: CodeType) -> dict[str, list[CodeType]]:
    """Return the code of every function of a module, by its qualified name."""
    found: dict[str, list[CodeType]] = {}
    for part in code.co_consts:
        if isinstance(part, CodeType):
            if part.co_flags & CO_OPTIMIZED:  # the body of a class is not
                found.setdefault(part.co_qualname, []).append(part)
            for name, parts in functions(part).items():
                found.setdefault(name, []).extend(parts)
    return found


def broken_code(promise: Promise) -> dict[str, CodeType]:
    """Compile the functions of the broken file that differ, by name; none where what differs is no function's."""
    path = ROOT / promise.file
    source = path.read_text()
    whole, broken = (functions(compile(text, str(path), "exec")) for text in (source, source.replace(promise.old, promise.new)))
    return {n: c[0] for n, c in broken.items() if len(c) == len(whole.get(n, ())) == 1 and told(c[0]) != told(whole[n][0])}


def told(code: CodeType) -> tuple[object, ...]:
    """Describe what a function does, wherever it is in its file."""
    return code.co_code, code.co_names, tuple(told(c) if isinstance(c, CodeType) else (type(c), c) for c in code.co_consts)


@contextmanager
def broken(promise: Promise) -> Iterator[None]:
    """Break the promise in the functions of this process."""
    path, new = str(ROOT / promise.file), broken_code(promise)
    importlib.import_module(promise.file.removesuffix(".py").replace("/", "."))
    gc.unfreeze()  # else what was set aside before a process was forked is not listed
    live = [f for f in gc.get_objects() if type(f) is FunctionType and f.__code__.co_filename == path and f.__code__.co_qualname in new]
    kept = [(f, f.__code__) for f in live]
    missing = {name for name in new if "<locals>" not in name} - {code.co_qualname for _, code in kept}
    assert not missing, f"{promise.file}: {missing} cannot be changed while it runs"
    for function, code in kept:
        function.__code__ = new[code.co_qualname]
    try:
        yield
    finally:
        for function, code in kept:
            function.__code__ = code


class Rest:
    """Rest after a test: the session, with the server and the databases that tests copy."""

    def __init__(self, session: pytest.Session) -> None:
        self.session = session

    def listchain(self) -> list[object]:
        """List what stays set up."""
        return [self.session]


class Breaker:
    """Runs, instead of each collected test once, the test of each promise whole and broken."""

    def __init__(self, promises: list[Promise]) -> None:
        self.promises = promises
        self.missed: list[Promise] = []

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Take the place of the loop over all tests."""
        passed: dict[str, bool] = {}
        for promise in self.promises:
            items = [i for i in session.items if i.nodeid.partition("[")[0].startswith(promise.test)]
            assert items, f"{promise.test} was not found"
            if promise.test not in passed:
                passed[promise.test] = all(self.passes(item, session, tell=True) for item in items)
            with broken(promise):
                noticed = not all(self.passes(item, session) for item in items)
            self.told(promise, noticed if passed[promise.test] else None)
        return True

    def passes(self, item: pytest.Item, session: pytest.Session, tell: bool = False) -> bool:
        """Run one test; what others share stays until the end. `tell` why it fails."""
        reports = runtestprotocol(item, log=False, nextitem=Rest(session))  # type: ignore[arg-type]
        for report in reports if tell else ():
            if not report.passed:
                say(report.longreprtext)
        return all(report.passed for report in reports)

    def told(self, promise: Promise, noticed: bool | None) -> None:
        """Say whether the test noticed; None where it fails with the promise kept, so that it shows nothing."""
        if not noticed:
            self.missed.append(promise)
        word = "FAILS WHOLE" if noticed is None else "noticed" if noticed else "MISSED"
        say(f"{word:12}{promise.said}  ({promise.test})")


def noticed_apart(promise: Promise) -> bool | None:
    """Check whether the test fails on a broken copy of the code, for what is read at import; None where it fails unbroken."""
    return None if not passes_apart(promise.test) else not passes_apart(promise.test, promise)


@cache
def passes_apart(test: str, promise: Promise | None = None) -> bool:
    """Check whether a test passes, and is not skipped, in its own process on a copy of the code with a broken promise."""
    with tempfile.TemporaryDirectory(prefix="betaloop-promises-") as place:
        folder = Path(place)
        folder.chmod(0o711)  # PostgreSQL's own user passes through
        for name in COPIED:
            (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, folder / name)
        if promise is not None:
            path = folder / promise.file
            path.write_text(path.read_text().replace(promise.old, promise.new))
        recordings = os.environ.get("BETALOOP_TEST_DATA", str(ROOT.parent / "shared" / "data"))  # as tests/conftest.py, from another folder
        env = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", "BETALOOP_TEST_DATA": recordings}
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", test]
        done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
        if done.returncode not in (0, 1):
            raise RuntimeError(f"{test} could not be run: {done.stdout[-2000:]}{done.stderr[-2000:]}")
        passed = done.returncode == 0 and " skipped" not in done.stdout.splitlines()[-1]
        if promise is None and not passed:
            say(done.stdout[-2000:])
        return passed


def main(words: list[str]) -> int:
    """Break each promise; 1 where a test did not notice."""
    here = [p for p in wanted(words) if not p.at_start and broken_code(p)]
    breaker = Breaker(here)
    if here:
        pytest.main(["-q", "-p", "no:cacheprovider", *sorted({p.test for p in here})], plugins=[breaker])
    for promise in wanted(words):
        if promise not in here:
            breaker.told(promise, noticed_apart(promise))
    say(f"{len(breaker.missed)} of {len(wanted(words))} broken promises were not noticed")
    return 1 if breaker.missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
