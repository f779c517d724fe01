"""Rules of the code that no linter knows."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def sources(*folders: str) -> dict[str, str]:
    """Source files by path relative to the root."""
    return {str(p.relative_to(ROOT)): p.read_text() for folder in folders for p in sorted((ROOT / folder).rglob("*.py"))}


SESSION_IN_SQL = re.compile(r'\b(from|join|update|into)\s+(public\.)?"?session"?\b', re.IGNORECASE)
ARM_IN_SQL = re.compile(r"\b(controller|policy_id)\b|\bselect\s+(\w+\.)?\*", re.IGNORECASE)


def texts(tree: ast.AST) -> Iterator[str]:
    """Every string of a file; one that is put together of pieces, over however many lines, is one text."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        elif isinstance(node, ast.JoinedStr):
            yield "".join(v.value if isinstance(v, ast.Constant) else " " for v in node.values)  # type: ignore[misc]
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            yield "".join(texts(node.left)) + "".join(texts(node.right))


def reads_the_arm(source: str) -> bool:
    """Whether code reads which controller or policy a session had: by attribute, by name, by column, or by SQL."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr in ("_controller", "_policy_id"):
            return True
        if isinstance(node, ast.Constant) and node.value in ("_controller", "_policy_id"):
            return True
        is_column = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute) and node.value.attr in ("c", "columns")
        if is_column and node.attr in ("controller", "policy_id") and "StudySession" in ast.unparse(node):
            return True
    return any(SESSION_IN_SQL.search(text) and ARM_IN_SQL.search(text) for text in texts(tree))


def test_only_the_gate_reads_which_controller_a_session_had() -> None:
    readers = {path for path, text in sources("app").items() if reads_the_arm(text)}
    assert readers == {"app/study/blinding.py"}


@pytest.mark.parametrize(
    "source",
    [
        "x = session._controller",
        "session._policy_id = 3",
        "x = getattr(session, '_controller')",
        "x = select(StudySession.__table__.c.controller)",
        "text('select session.controller from session')",
        "text('select controller,'\n     ' count(*)'\n     ' from session group by 1')",
        'text("""select v.number,\n  s.policy_id\nfrom visit v\njoin session s on s.visit_id = v.id""")',
        "text('select id, policy_id' + ' from session')",
        "text(f'select {columns}, controller from session where id = {i}')",
        "text('select * from session')",
    ],
)
def test_every_way_to_read_the_arm_is_seen(source: str) -> None:
    assert reads_the_arm(source)


@pytest.mark.parametrize(
    "source",
    [
        "x = plan.controller",
        "text('select count(*) from session')",
        "text('select controller from plan_item')",
        "x = 'from session to session'",
    ],
)
def test_what_reads_no_arm_is_left_alone(source: str) -> None:
    assert not reads_the_arm(source)


def test_every_table_is_audited_or_known_not_to_be() -> None:
    from app.platform.audit import AUDITED
    from app.platform.database import Base
    from app.platform.tables import load_tables

    load_tables()
    not_audited = {"audit_event", "sign_in_attempt", "job_step", "job_event", "worker"}
    assert set(Base.metadata.tables) == set(AUDITED) | not_audited


def test_the_migration_audits_what_the_code_says() -> None:
    from app.platform.audit import AUDITED

    text = "".join(p.read_text() for p in (ROOT / "migrations" / "versions").glob("*.py"))
    for table in AUDITED:
        assert f'("{table}", ' in text


def test_no_source_file_outgrows_a_reader() -> None:
    long = {path: text.count("\n") for path, text in sources("app", "ml").items() if text.count("\n") > 420}
    assert long == {}


def commits(source: str) -> bool:
    """Whether code calls `commit`, whatever it calls the session."""
    calls = (node.func for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    return any(isinstance(called, ast.Attribute) and called.attr == "commit" for called in calls)


def test_only_who_was_called_from_outside_commits() -> None:
    reasons = {
        "app/platform/database.py": "the transaction of commands and workers",
        "app/accounts/service.py": "the time a caller was last seen is no part of the request",
        "app/ingest/uploads/service.py": "an upload commits when its bytes are safe",
        "app/ingest/uploads/receiving.py": "an upload commits when its bytes are safe, and when each file is decoded",
        "app/ingest/uploads/in_progress.py": "an advisory lock on a connection of its own, without a transaction left open",
        "app/ingest/quarantine/service.py": "who looked at a file is on record before the bytes leave; bytes go after the row says so",
        "app/simulation/loop.py": "a command of many transactions",
        "app/simulation/sessions.py": "a command of many transactions",
    }
    doors = re.compile(r"(^|_)(api|pages)\.py$")
    committing = {p for p, text in sources("app").items() if not doors.search(Path(p).name) and commits(text)}
    assert committing == set(reasons)


@pytest.mark.parametrize("source", ["db.commit()", "self.session.commit()", "with_session(lambda s: s.commit())"])
def test_a_commit_is_seen_whatever_the_session_is_called(source: str) -> None:
    assert commits(source)


def test_every_local_link_in_a_template_leads_to_a_page() -> None:
    patterns = [re.compile("^" + re.sub(r"{[^}]+}", "[^/]+", path) + "$") for path in page_paths()]
    broken = []
    for template in sorted((ROOT / "app" / "templates").rglob("*.html")):
        for link in re.findall(r'(?:href|action)="(/[^"]*|{{ base }}/[^"]*)"', template.read_text()):
            link = link.replace("{{ base }}", "/participants/x")
            target = re.sub(r"{{.*?}}|{%.*?%}", "x", link.split("?")[0].split("#")[0])
            if not target.startswith("/static/") and not any(p.match(target) for p in patterns):
                broken.append(f"{template.name}: {link}")
    assert broken == []


def page_paths() -> set[str]:
    """Paths of every page and of every route of the interface."""
    from importlib import import_module

    from fastapi.routing import iter_route_contexts

    from app.main import API_MODULES, PAGE_MODULES
    from app.platform.tables import load_tables

    load_tables()

    def routes(name: str) -> Iterable[str]:
        return (context.path for context in iter_route_contexts(import_module(name).router.routes) if context.path)

    return {p for name in PAGE_MODULES for p in routes(name)} | {f"/api/v1{p}" for name in API_MODULES for p in routes(name)}
