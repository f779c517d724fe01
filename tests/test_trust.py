"""docs/trust.md: every clause has a test that exists, or says that it is not covered."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from pathlib import Path

import pytest

from tests.promises import PROMISES

ROOT = Path(__file__).resolve().parents[1]
TEST = re.compile(r"`(?:(tests/[\w/]+\.py)(?:: )?)?(test_\w+)?`")
NOT_BROKEN: set[str] = set()
"""Tests that the document names and that no promise is shown by, each with its reason: what would break them was not tried."""


@cache
def homes() -> dict[str, list[str]]:
    """Map each test to the files that define it."""
    found: dict[str, list[str]] = {}
    for path in (ROOT / "tests").rglob("test_*.py"):
        for name in re.findall(r"^ *(?:async )?def (test_\w+)\(", path.read_text(), re.MULTILINE):
            found.setdefault(name, []).append(path.relative_to(ROOT).as_posix())
    return found


def named_in(text: str) -> list[tuple[str, str]]:
    """List the tests that a text names, with their files; one named without its file must be in one file alone.

    Raises:
        ValueError: a test is in no file or in several, or not in the one that is named.
    """
    named = [(path, name) for path, name in TEST.findall(text) if path or name]
    for path, name in named:
        known = homes().get(name, [])
        if name and (path not in known if path else len(known) != 1):
            raise ValueError(f"{path or 'no file'} for {name}, which is in {known}")
    return [(path or homes()[name][0], name) for path, name in named]


def rows() -> list[tuple[str, str, str]]:
    """List clause, what is done and what shows it, of every row of the tables."""
    found = []
    for line in (ROOT / "docs" / "trust.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and not set(line) <= set("|-") and cells[0] not in ("clause", "chapter", "found"):
            assert len(cells) == 3, line
            found.append((cells[0], cells[1], cells[2]))
    return found


def test_every_clause_is_shown_by_a_test_or_said_not_to_be_covered() -> None:
    assert [clause for clause, done, shown in rows() if not named_in(shown) and "not covered" not in done] == []


@pytest.mark.parametrize(
    "text", ["`test_nowhere`", "`test_any_change_breaks_it_visibly`", "`tests/test_docs.py: test_the_lists_are_whole`"]
)
def test_a_name_that_leads_to_no_test_is_noticed(text: str) -> None:
    with pytest.raises(ValueError, match="which is in"):
        named_in(text)


def test_the_lists_are_whole() -> None:
    """The clauses of subparts B and C, and the chapters of the standard."""
    text = " ".join(clause for clause, _, _ in rows())
    for clause in (
        *(f"11.10({c})" for c in "abcdefghijk"),
        "11.30",
        "11.50",
        "11.70",
        *(f"11.300({c})" for c in "abcde"),
        "11.200(a)",
        "11.200(b)",
    ):
        assert clause in text, clause
    for chapter in range(1, 15):
        assert re.search(rf"\bV{chapter}\b", text), f"V{chapter}"


def test_the_rules_of_bandit_are_checked() -> None:
    lint = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["ruff"]["lint"]
    assert "S" in lint["select"]
    # what is excluded is written down here and in pyproject.toml with its reason: nothing that calls a shell or builds SQL
    assert {rule for rule in lint["ignore"] if rule.startswith("S")} == {"S101", "S603", "S607"}
    assert {names for names, rules in lint["per-file-ignores"].items() if "S" in rules} == {"benchmarks/*", "tests/*"}


def test_every_promise_that_is_broken_on_purpose_is_still_there() -> None:
    """`python -m tests.broken_promises` breaks them; here only that each would be another code, and that its test is there."""
    for promise in PROMISES:
        path, _, name = promise.test.partition("::")
        assert (ROOT / promise.file).read_text().count(promise.old) == 1, promise
        assert promise.new != promise.old
        assert not name or f"def {name.rpartition('::')[2]}(" in (ROOT / path).read_text(), promise


def test_the_tests_without_a_change_that_breaks_them_are_listed() -> None:
    """Those that the document names and that no promise is shown by: it says where they are listed, and claims no more."""
    text = (ROOT / "docs" / "trust.md").read_text()
    named = {f"{path}::{name}" for path, name in named_in(text) if name}
    # a method of a class is named without the class
    broken = {re.sub(r"::\w+::", "::", promise.test) for promise in PROMISES}
    assert named - broken == NOT_BROKEN
    assert "`NOT_BROKEN` in `tests/test_trust.py`" in text
