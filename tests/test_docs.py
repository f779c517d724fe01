"""Names in README and the documentation exist: commands and options, make targets, routes, settings, files, names in files."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer
from fastapi.routing import iter_route_contexts

from app.cli import app as commands
from app.main import create_app
from app.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
CODE_FOLDERS = ("app", "ml", "tests", "benchmarks", "migrations", "static", "docs", ".ci")
SUFFIXES = ("py", "md", "toml", "yml", "ini", "lock", "svg")
METHOD = r"(GET|POST|PUT|PATCH|DELETE)"


class Code(NamedTuple):
    """A piece of code in a document: between backticks, or a line of a block."""

    text: str
    line: str
    number: int


def pieces(markdown: str) -> Iterator[Code]:
    """Yield every piece of code; in a block a line that ends with a backslash goes on."""
    block = False
    for number, line in enumerate(markdown.replace("\\\n", " ").splitlines(), 1):
        if line.lstrip().startswith("```"):
            block = not block
        elif block:
            yield Code(line.split("  #")[0].strip(), line, number)
    # a span may be broken by the end of a line
    prose = re.sub(r"^```.*?^```", lambda m: "\n" * m[0].count("\n"), markdown, flags=re.MULTILINE | re.DOTALL)
    for span in re.finditer(r"(?<!`)`([^`]+)`(?!`)", prose):
        start = prose.rfind("\n", 0, span.start()) + 1
        yield Code(
            " ".join(span[1].split()), prose[start : (prose.find("\n", span.end()) + 1 or None)], prose.count("\n", 0, span.start()) + 1
        )


# commands


@cache
def command_tree() -> Any:
    """Return the command line as click has it."""
    return typer.main.get_command(commands)


def wrong_command(words: list[str], options: list[str]) -> str | None:
    """Explain what is wrong with `betaloop words... options...`."""
    node, path = command_tree(), "betaloop"
    for word in words:
        known = getattr(node, "commands", None)
        if known is None:
            break  # an argument
        if word not in known:
            return f"no command {path} {word}"
        node, path = known[word], f"{path} {word}"
    offered = {o for p in node.params for o in [*p.opts, *p.secondary_opts]} | {"--help"}
    missing = [o for o in options if o not in offered]
    return f"{path} has no {', '.join(missing)}" if missing else None


@cache
def every_option() -> set[str]:
    """Collect options of all commands together."""
    nodes = [command_tree()]
    for node in nodes:
        nodes += getattr(node, "commands", {}).values()
    return {option for node in nodes for p in node.params for option in [*p.opts, *p.secondary_opts]}


def commands_of(code: Code) -> Iterator[tuple[list[str], list[str]]]:
    """Yield (words, options) of every call of betaloop in a piece of code."""
    for call in re.findall(r"(?:^|[\s/])betaloop((?:\s+[^\s|;#&)]+)*)", code.text):
        words: list[str] = []
        for word in call.split():
            if not re.fullmatch(r"[a-z][a-z-]*", word):
                break
            words.append(word)
        yield words, re.findall(r"(?<![\w-])--[a-z][a-z-]*", call)


def wrong_commands(markdown: str) -> list[str]:
    """List calls of betaloop that the command line does not offer."""
    found = []
    for code in pieces(markdown):
        calls = list(commands_of(code))
        if code.text.startswith("betaloop ") and calls:
            # `betaloop ingest redecode` · `resume`: the others are in the same group
            group = calls[0][0][:-1]
            following = code.line.split(f"`{code.text}`", 1)[-1]
            siblings = re.match(r"(?: · `[^`]+`)*", following)
            for other in re.findall(r"`([^`]+)`", siblings[0] if siblings else ""):
                calls.append(([*group, other.split()[0]], re.findall(r"--[a-z][a-z-]*", other)))
        found += [f"line {code.number}: {wrong}" for words, options in calls if (wrong := wrong_command(words, options))]
    return found


# make targets


def wrong_targets(markdown: str) -> list[str]:
    """List targets that the Makefile lacks."""
    targets = set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = [(code, t) for code in pieces(markdown) for t in re.findall(r"(?:^|[;&] *)make ([a-z][a-z-]*)", code.text)]
    return [f"line {code.number}: no target {target}" for code, target in named if target not in targets]


# routes


@cache
def routes() -> set[tuple[str, str]]:
    """Collect (method, path) of every route, pages too."""
    contexts = iter_route_contexts(create_app().routes)
    return {(method, c.path) for c in contexts if c.path for method in (getattr(c, "methods", None) or ())}


def is_route(path: str, method: str | None, ending: bool = False) -> bool:
    """Check whether a path, with numbers, codes or other names in place of its parameters, is a route; `ending`: or the end of one."""
    wanted = re.sub(r"{[^}]*}", "x", path.split("?")[0].rstrip("/.")) or "/"
    for known_method, known in routes():
        if method is not None and known_method != method:
            continue
        pattern = re.sub(r"{[^}]*}", "[^/]+", known.replace(".", r"\."))
        own = (pattern, pattern.removeprefix("/api/v1"))
        if any(re.fullmatch((".*" if ending else "") + p, wanted) or (ending and re.search(f"{re.escape(wanted)}$", known)) for p in own):
            return True
    return False


def wrong_routes(markdown: str) -> list[str]:
    """List routes, with their methods where these are stated, that the service lacks."""
    found = []
    for code in pieces(markdown):
        named: list[tuple[str | None, str]] = []
        if curl := re.search(r"\$API(/[^\s'\"]*)", code.text):
            stated = re.search(rf"-X {METHOD}", code.text)
            sends = re.search(r" -(d|F|-data|-form)\b", code.text)
            named.append((stated[1] if stated else "POST" if sends else "GET", f"/api/v1{curl[1]}"))
        elif spoken := re.fullmatch(rf"{METHOD} (…?/\S+)", code.text):
            named.append((spoken[1], spoken[2]))
        elif re.fullmatch(r"/api/v1/\S+", code.text) or re.fullmatch(r"…/\S+|/[a-z-]+", code.text):
            named.append((None, code.text))
        for method, path in named:
            # what follows a route in a sentence (`/discard`, `…/split`) is the end of one
            ending = path.startswith("…") or (method is None and not path.startswith("/api/"))
            if not is_route(path.removeprefix("…"), method, ending):
                found.append(f"line {code.number}: no route {method or ''} {path}")
    return found


# settings


def wrong_settings(markdown: str) -> list[str]:
    """List environment variables that nothing reads."""
    known = {f"BETALOOP_{name.upper()}" for name in Settings.model_fields}
    read = "".join(p.read_text() for folder in ("tests", "benchmarks") for p in (ROOT / folder).rglob("*.py") if p != Path(__file__))
    known |= set(re.findall(r"environ(?:\.get\(|\[)\"(BETALOOP_[A-Z_]+)\"", read))
    return [f"no setting {name}" for name in sorted(set(re.findall(r"BETALOOP_[A-Z][A-Z_]*", markdown)) - known)]


# files, modules, and names in them


@cache
def tree() -> tuple[str, ...]:
    """List every file and folder of the repository that a document may name."""
    top = [p for p in ROOT.iterdir() if p.is_file()]
    inner = [p for folder in CODE_FOLDERS if (ROOT / folder).exists() for p in (ROOT / folder).rglob("*") if "__pycache__" not in p.parts]
    return tuple(str(p.relative_to(ROOT)) for p in [*top, *inner, *(ROOT / f for f in CODE_FOLDERS)])


def named_paths(text: str) -> Iterator[tuple[str, str | None]]:
    """Yield (path, name in it) that a piece of code names: `ml/qoc.py`, `app/study`, `traces.py: step_table`, `rl*.py`."""
    folders = "|".join(map(re.escape, CODE_FOLDERS))
    for match in re.finditer(
        rf"(?<![\w/.$-])((?:{folders})/[\w./*-]+|[\w*-]+\.(?:{'|'.join(SUFFIXES)}))(?!\w|\.\w)(?::{{1,2}} ?([A-Za-z_]\w*))?", text
    ):
        yield match[1].rstrip("./"), match[2]


def files_of(path: str) -> list[str]:
    """List files and folders that a path means, from the root or from anywhere."""
    pattern = re.compile(r"(?:.*/)?" + re.escape(path).replace(r"\*", "[^/]*"))
    return [known for known in tree() if pattern.fullmatch(known)]


def wrong_files(markdown: str) -> list[str]:
    """List paths that lead nowhere, and names that their file does not hold."""
    found = []
    for code in pieces(markdown):
        for path, name in named_paths(code.text):
            files = [ROOT / f for f in files_of(path)]
            if not files:
                found.append(f"line {code.number}: no file {path}")
            elif name and not any(defines(f.read_text(), name) for f in files if f.is_file()):
                found.append(f"line {code.number}: {path} has no {name}")
        for module in re.findall(r"(?<![\w./])((?:app|ml|benchmarks)(?:\.[a-z_]\w*)+)(?!\w)", code.text):
            if not is_module(module) and not (ROOT / module.replace(".py", "")).exists():
                found.append(f"line {code.number}: no module {module}")
    return found


def defines(source: str, name: str) -> bool:
    """Check whether a file gives a name a meaning: a function, a class, a value, a field."""
    return re.search(rf"^\s*(?:async )?(?:def|class) {name}\b|^\s*{name}\s*[:=]", source, re.MULTILINE) is not None


def is_module(dotted: str) -> bool:
    """Check whether a dotted name is a module, or a name in one."""
    parts = dotted.split(".")
    for k in range(len(parts), 0, -1):
        try:
            spec = find_spec(".".join(parts[:k]))
        except ModuleNotFoundError:
            continue
        if spec is not None:
            return k == len(parts) or bool(spec.origin and defines(Path(spec.origin).read_text(), parts[k]))
    return False


def wrong_options(markdown: str) -> list[str]:
    """List options of benchmarks that the script does not know, and options named alone that nothing has."""
    found = []
    scripts = "".join(p.read_text() for p in (ROOT / "benchmarks").rglob("*.py"))
    for code in pieces(markdown):
        alone = re.findall(r"(?<![\w-])--[a-z][a-z-]*", code.text) if code.text.startswith("--") else []
        found += [f"line {code.number}: no option {o}" for o in alone if o not in every_option() and f'"{o}"' not in scripts]
        if script := re.search(r"(benchmarks/[\w/]+\.py|-m benchmarks\.[\w.]+)(.*)", code.text):
            file = ROOT / (script[1] if "/" in script[1] else script[1].removeprefix("-m ").replace(".", "/") + ".py")
            # every script takes the options of what runs it
            source = file.read_text() + (ROOT / "benchmarks/support/results.py").read_text() if file.exists() else ""
            missing = [o for o in re.findall(r"(?<![\w-])--[a-z][a-z-]*", script[2]) if source and f'"{o}"' not in source]
            found += [f"line {code.number}: {script[1]} has no {option}" for option in missing]
    return found


def anchors(markdown: str) -> set[str]:
    """Collect places that a link can lead to."""
    heads = re.findall(r"^#+ (.+)$", markdown, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


def wrong_links(markdown: str, document: Path) -> list[str]:
    """List links to files and headings that do not exist."""
    found = []
    for target in re.findall(r"(?<!`)\]\(([^)\s]+)\)", markdown):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (document.parent / path).resolve() if path else document
        if not file.exists():
            found.append(f"no file {target}")
        elif anchor and anchor not in anchors(file.read_text()):
            found.append(f"no heading {target}")
    return found


def wrong(markdown: str, document: Path) -> list[str]:
    """List everything that a document names and that does not exist."""
    checks = (wrong_commands, wrong_targets, wrong_routes, wrong_settings, wrong_files, wrong_options)
    return [*(found for check in checks for found in check(markdown)), *wrong_links(markdown, document)]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_what_a_document_names_exists(document: Path) -> None:
    assert wrong(document.read_text(), document) == []


def test_a_page_is_short_enough_to_be_read() -> None:
    allowed = {"architecture.md", "hazards.md", "operations.md", "trust.md"}  # lists, and what is still to be shortened
    assert {p.name for p in DOCUMENTS if p.stat().st_size > 12_288} <= allowed


def test_every_picture_is_shown_by_a_document() -> None:
    shown = {(d.parent / target).resolve() for d in DOCUMENTS for target in re.findall(r"!\[[^\]]*\]\(([^)\s]+)\)", d.read_text())}
    assert {p for p in (ROOT / "docs").rglob("*") if p.is_file() and p.suffix != ".md"} <= shown


@pytest.mark.parametrize(
    ("markdown", "says"),
    [
        ("`betaloop fly`", "no command betaloop fly"),
        ("`betaloop ingest redecode` · `forget`", "no command betaloop ingest forget"),
        ("`.venv/bin/betaloop demo --colour red`", "betaloop demo has no --colour"),
        ("```\nbetaloop user remove x\n```", "no command betaloop user remove"),
        ("`make coffee`", "no target coffee"),
        ("`GET /api/v1/nothing`", "no route GET /api/v1/nothing"),
        ("`DELETE /participants/{code}`", "no route DELETE"),
        ('```\ncurl -H "$AUTH" -X PUT $API/sessions/1\n```', "no route PUT /api/v1/sessions/1"),
        ("`PATCH /proposals/{id}`, `…/forget`", "no route  …/forget"),
        ("BETALOOP_COLOUR", "no setting BETALOOP_COLOUR"),
        ("`app/nothing.py`", "no file app/nothing.py"),
        ("`nothing_of_this_name.py`", "no file nothing_of_this_name.py"),
        ("`ml/mdp.py: no_such_name`", "ml/mdp.py has no no_such_name"),
        ("`ml.nothing.at_all`", "no module ml.nothing.at_all"),
        ("`python benchmarks/ope.py --warp 9`", "benchmarks/ope.py has no --warp"),
        ("`python -m benchmarks.evaluation.portfolio --warp 9`", "-m benchmarks.evaluation.portfolio has no --warp"),
        ("`python -m benchmarks.portfolio`", "no module benchmarks.portfolio"),
        ("`betaloop control` with `--warp`", "no option --warp"),
        ("[x](nothing.md)", "no file nothing.md"),
        ("[x](README.md#no-such-heading)", "no heading README.md#no-such-heading"),
    ],
)
def test_what_does_not_exist_is_found(markdown: str, says: str) -> None:
    assert any(says in found for found in wrong(markdown, ROOT / "README.md")), wrong(markdown, ROOT / "README.md")


@pytest.mark.parametrize(
    "markdown",
    [
        "`betaloop import PATH --participant CODE` and `betaloop` and `betaloop ingest redecode` · `resume`",
        "`make test`, `GET /api/v1/bundle-key`, `PATCH /proposals/{session_id}`, `POST …/confirm`, `/discard`, `/api/v1/openapi.json`",
        '```\ncurl $API/participants/P9/jobs -d \'{"kind": "pipeline"}\'\ncurl -X PUT $API/sessions/1/qoc\n```',
        "BETALOOP_DATA_DIR `ml/mdp.py: step_reward` `mdp.py` `rl*.py` `app/study` `ml.mdp.MdpSettings` [x](docs/population/cohort.md)",
        "`sheet.html`, `/srv/betaloop`, `t_s <= 0`, `amplitude/cDBS`, `betaloop.study`",
    ],
)
def test_what_exists_is_let_pass(markdown: str) -> None:
    assert wrong(markdown, ROOT / "README.md") == []


def test_change_fragments_have_a_type_that_the_changelog_knows() -> None:
    names = [path.name for path in (ROOT / "changes").glob("[!.]*")]
    assert [name for name in names if not re.fullmatch(r"\+[a-z0-9-]+\.(added|changed|fixed)\.md", name)] == []
    drafted = subprocess.run(
        [sys.executable, "-m", "towncrier", "build", "--draft", "--version", "0"], cwd=ROOT, capture_output=True, text=True
    )
    assert drafted.returncode == 0, drafted.stderr
