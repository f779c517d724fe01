"""Rules of the house that no linter knows."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def sources(*folders: str) -> dict[str, str]:
    """Source files by path relative to the root."""
    return {str(p.relative_to(ROOT)): p.read_text() for folder in folders for p in sorted((ROOT / folder).rglob("*.py"))}


def test_only_the_gate_reads_which_controller_a_session_had() -> None:
    allowed = {"app/study/models.py", "app/study/blinding.py"}
    readers = {path for path, text in sources("app").items() if re.search(r"\.(_controller|_policy_id)\b", text)}
    assert readers <= allowed
    by_sql = {path for path, text in sources("app").items() if re.search(r"session\.(controller|policy_id)\b.*\bfrom session\b", text)}
    assert by_sql == set()


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


def test_services_leave_the_commit_to_their_callers() -> None:
    # an upload commits when its bytes are safe; a sign-in's last-seen time is no part of the request
    allowed = {"app/ingest/uploads/service.py", "app/accounts/service.py"}
    committing = {p for p, t in sources("app").items() if p.endswith(("service.py", "repository.py")) and "db.commit()" in t}
    assert committing <= allowed


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
