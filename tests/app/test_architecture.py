"""Rules of the code that no linter knows."""

from __future__ import annotations

import ast
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def sources(*folders: str) -> dict[str, str]:
    """Read source files by path relative to the root."""
    return {str(p.relative_to(ROOT)): p.read_text() for folder in folders for p in sorted((ROOT / folder).rglob("*.py"))}


def repository_files() -> Iterator[Path]:
    """Yield every file of the repository, relative to its root, without what git ignores."""
    ignored = {".git", *(ROOT / ".gitignore").read_text().replace("/\n", "\n").split()}
    for folder, below, names in os.walk(ROOT):
        below[:] = [name for name in below if not any(fnmatch(name, pattern) for pattern in ignored)]
        yield from (Path(folder, name).relative_to(ROOT) for name in names if not any(fnmatch(name, pattern) for pattern in ignored))


SESSION_IN_SQL = re.compile(r'\b(from|join|update|into)\s+(public\.)?"?session"?\b', re.IGNORECASE)
ARM_IN_SQL = re.compile(r"\b(controller|policy_id)\b|\bselect\s+(\w+\.)?\*", re.IGNORECASE)


def texts(tree: ast.AST) -> Iterator[str]:
    """Yield every string of a file; one that is put together of pieces, over however many lines, is one text."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        elif isinstance(node, ast.JoinedStr):
            yield "".join(v.value if isinstance(v, ast.Constant) else " " for v in node.values)  # type: ignore[misc]
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            yield "".join(texts(node.left)) + "".join(texts(node.right))


def reads_the_arm(source: str) -> bool:
    """Check whether code reads which controller or policy a session had: by attribute, by name, by column, or by SQL."""
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
    from app.tables import METADATA

    not_audited = {"audit_event", "audit_link", "audit_seal", "sign_in_attempt", "job_step", "job_event", "worker", "counted_time"}
    assert set(METADATA.tables) == set(AUDITED) | not_audited


def test_every_table_is_defined_among_the_tables() -> None:
    defined = {path for path, text in sources("app").items() for node in ast.walk(ast.parse(text)) if is_table(node)}
    assert {str(Path(path).parent) for path in defined} == {"app/tables"}


def is_table(node: ast.AST) -> bool:
    """Return True for a statement that defines a mapped class."""
    return isinstance(node, ast.ClassDef) and any(isinstance(base, ast.Name) and base.id == "Base" for base in node.bases)


def test_the_migration_audits_what_the_code_says() -> None:
    from app.platform.audit import AUDITED

    text = "".join(p.read_text() for p in (ROOT / "migrations" / "versions").glob("*.py"))
    for table in AUDITED:
        assert f'("{table}", ' in text


def test_no_source_file_outgrows_a_reader() -> None:
    code = [p for p in repository_files() if p.suffix in (".py", ".js", ".css", ".html") and p.parent != Path("migrations/versions")]
    assert {p.parts[0] for p in code} >= {"app", "ml", "benchmarks", "static", "tests"}
    lines = {str(p): (ROOT / p).read_text().count("\n") for p in code}
    assert {path: n for path, n in lines.items() if n > 400} == {}


QUERY_NAMES = {"select", "insert", "update", "delete", "text"}
QUERY_METHODS = {"execute", "scalar", "scalars", "query"}


def calls(text: str) -> set[tuple[bool, str]]:
    """List every call in a source text: whether it is a method's, and its name."""
    functions = [node.func for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    named = {(False, f.id) for f in functions if isinstance(f, ast.Name)}
    return named | {(True, f.attr) for f in functions if isinstance(f, ast.Attribute)}


def is_query(call: tuple[bool, str]) -> bool:
    method, name = call
    return name in (QUERY_METHODS if method else QUERY_NAMES)


RULES_WITH_QUERIES = """
accounts/sign_on accounts/studies analysis/evaluations analysis/evidence analysis/pooled analysis/primary overview/trail_rows
overview/trail_scope study/adverse_events study/data_queries study/doses study/margins study/outcomes/hand study/outcomes/values
study/recordings/controller_log study/recordings/facts
""".split()  # noqa: SIM905
"""Small features that keep their rules and their queries in one file."""
LOCKS = {"app/ingest/uploads/in_progress.py", "app/simulation/run.py"}
"""Both hold an advisory lock on a connection of their own, which outlives the transactions of the work that it guards."""


def decisions(function: ast.AST) -> set[str]:
    """Name what a function refuses or asks permission for, but that it has not found a row."""
    raised = {ast.unparse(n.exc).partition("(")[0] for n in ast.walk(function) if isinstance(n, ast.Raise) and n.exc}
    asked = {name for _, name in calls(ast.unparse(function)) if name == "may" or name.startswith("require")}
    return raised - {"NotFound"} | asked


def queries_that_decide(text: str) -> set[str]:
    """Name the functions of a source text that ask the database and decide something."""
    functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
    return {f.name for f in functions if any(map(is_query, calls(ast.unparse(f)))) and decisions(f)}


def test_only_queries_ask_the_database() -> None:
    asking = {path: text for path, text in sources("app").items() if any(map(is_query, calls(text)))}
    found = {path for path in asking if not path.startswith(("app/platform/", "app/tables/")) and not path.endswith("/repository.py")}
    assert found == {f"app/{name}.py" for name in RULES_WITH_QUERIES} | LOCKS


WEB = re.compile(r"(.*_)?web|api|pages|deps")
"""Names of modules with routes, pages, and what their paths name."""


def test_rules_and_queries_never_use_routes_and_pages() -> None:
    from tests.architecture.measure import imports

    text = {path.removesuffix(".py").replace("/", "."): text for path, text in sources("app").items()}
    web = {name for name in text if WEB.fullmatch(name.rpartition(".")[2]) or "APIRouter(" in text[name]} - {"app.main"}
    # a command may do what a route does; the other one refuses a file before a route has read it
    users = web | {"app.main", "app.ingest.uploads.early_refusal"} | {name for name in text if name.endswith("commands")}
    assert {"app.accounts.deps", "app.accounts.studies_web"} <= web
    assert {f"{a} -> {b}" for a, b in imports() if b in web and a not in users} == set()


def test_a_query_beside_rules_decides_nothing() -> None:
    found = {name: queries_that_decide((ROOT / f"app/{name}.py").read_text()) for name in RULES_WITH_QUERIES}
    assert {name: functions for name, functions in found.items() if functions} == {}


@pytest.mark.parametrize(("line", "decides"), [("raise NotFound()", False), ("raise Invalid('no')", True), ("require(caller)", True)])
def test_a_query_that_decides_is_seen(line: str, decides: bool) -> None:
    assert bool(queries_that_decide(f"def row(db):\n    found = db.scalar(select(A))\n    {line}")) is decides


def test_the_session_commits_and_nothing_else_but_what_must_in_the_middle() -> None:
    allowed = {
        "app/platform/database/__init__.py",  # the session of a request, and the context manager that commands and jobs use
        # an upload commits when its bytes are safe and again when they are decoded, so that a crash in between loses nothing
        "app/ingest/uploads/receiving.py",
        "app/ingest/uploads/service.py",
        "app/ingest/uploads/in_progress.py",  # a count is taken back after its transaction was
        "app/ingest/quarantine/service.py",  # bytes are erased only after the decision is safe
        "app/accounts/sign_on.py",  # a refusal is in the trail whatever becomes of the request
        # a failed sign-in counts whatever becomes of the request; so does when a session or token was last used
        "app/accounts/service.py",
        "app/overview/commands.py",  # an export is in the trail before its first row is written, whatever becomes of the rest
        # the simulated study is a command in parts: it commits what a clinic would have committed
        "app/simulation/loop.py",
        "app/simulation/sessions.py",
    }
    found = {path for path, text in sources("app").items() if (True, "commit") in calls(text)}
    assert found == allowed


def test_no_folder_outgrows_a_reader() -> None:
    allowed = {"benchmarks", "changes", "docs/results"}  # a file is one command, one change, one run
    # features of a phase are files, two of most
    flat = {f"app/{phase}" for phase in ("analysis", "overview", "evaluation", "learning", "pipeline", "study")}
    folders = Counter(str(path.parent) for path in repository_files())
    assert {"app/templates", "benchmarks", "docs", "static", "tests/data"} <= set(folders)
    most = {folder: 32 if folder in flat else 15 for folder in folders}
    assert {folder: n for folder, n in folders.items() if n > most[folder] and folder not in allowed} == {}


def test_every_phase_and_feature_has_the_contract_of_its_layers() -> None:
    import tomllib

    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    held = next(c for c in contracts if c.get("containers"))["containers"]
    layered = {"api", "pages", "jobs", "service", "repository"}
    below = {str(Path(path).parent) for path in sources("app") if Path(path).stem in layered and Path(path).parent != Path("app")}
    known = {c.replace(".", "/") for c in held}
    assert {folder for folder in below if not folder.startswith(("app/platform", "app/tables"))} <= known


def test_the_check_of_queries_finds_one_and_takes_nothing_else_for_it() -> None:
    assert any(map(is_query, calls("rows = db.scalars(select(A))")))
    assert not any(map(is_query, calls("pdf.text(1, 2, word)")))


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
    """List paths of every page and of every route of the interface."""
    from fastapi.routing import iter_route_contexts

    from app.main import API_ROUTERS, PAGE_ROUTERS, router_of

    def routes(name: str) -> Iterable[str]:
        return (context.path for context in iter_route_contexts(router_of(name).routes) if context.path)

    return {p for name in PAGE_ROUTERS for p in routes(name)} | {f"/api/v1{p}" for name in API_ROUTERS for p in routes(name)}
