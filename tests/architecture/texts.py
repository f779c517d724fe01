"""Texts of the repository that people read: docstrings, comments, templates, documents, and messages in Python code.

Code, tables, addresses and identifiers are no text. Each text is given with its place.
"""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Iterator
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]


class Text(NamedTuple):
    """A piece of prose: where it begins, and the text without markup."""

    path: str
    line: int
    text: str


@cache
def tracked_files(root: Path = ROOT) -> tuple[str, ...]:
    """List the files of the repository, relative to its root, but migrations, which are written by a tool and never changed."""
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard", "-z"], cwd=root, check=True, capture_output=True, text=True)
    names = sorted(set(filter(None, listed.stdout.split("\0"))))
    return tuple(n for n in names if not n.startswith("migrations/versions/") and (root / n).is_file())


@cache
def source(path: str) -> str:
    """Read a file of the repository."""
    return (ROOT / path).read_text()


class Nodes(NamedTuple):
    """Nodes of a Python file by kind, found in one walk: walks take most of the time of these tests.

    Attributes:
        bodies: those with statements in them.
        functions: of every depth.
        calls: what is called.
        raised: statements that raise.
        long: strings over more than one line.
        imports: of any form.
        assigned: assignments.
    """

    bodies: list[Any]
    functions: list[ast.FunctionDef | ast.AsyncFunctionDef]
    calls: list[ast.Call]
    raised: list[ast.Raise]
    long: list[ast.expr]
    imports: list[ast.Import | ast.ImportFrom]
    assigned: list[ast.Assign]


@lru_cache(maxsize=1)
def nodes_of(path: str) -> Nodes:
    """Parse a Python file of the repository and sort its nodes; only the last tree is kept, for all of them would slow the collector."""
    found = sorted_nodes(ast.parse(source(path)))
    _imports[path] = found.imports
    return found


_imports: dict[str, list[ast.Import | ast.ImportFrom]] = {}


def imports_of(path: str) -> list[ast.Import | ast.ImportFrom]:
    """Return the imports of a Python file; these are kept of every file that was parsed."""
    return _imports[path] if path in _imports else nodes_of(path).imports


def sorted_nodes(tree: ast.Module) -> Nodes:
    """Walk a tree once and sort its nodes by kind."""
    found = Nodes([], [], [], [], [], [], [])
    stack: list[ast.AST] = [tree]
    while stack:
        node = stack.pop()
        kind = type(node)
        if kind in (ast.FunctionDef, ast.AsyncFunctionDef):
            found.functions.append(node)  # type: ignore[arg-type]
        elif kind is ast.Call:
            found.calls.append(node)  # type: ignore[arg-type]
        elif kind is ast.Raise:
            found.raised.append(node)  # type: ignore[arg-type]
        elif kind in (ast.Import, ast.ImportFrom):
            found.imports.append(node)  # type: ignore[arg-type]
        elif kind is ast.Assign:
            found.assigned.append(node)  # type: ignore[arg-type]
        elif kind in (ast.Constant, ast.JoinedStr):
            text = kind is ast.JoinedStr or isinstance(node.value, (str, bytes))  # type: ignore[attr-defined]
            if text and node.end_lineno > node.lineno:  # type: ignore[attr-defined]
                found.long.append(node)  # type: ignore[arg-type]
        for value in node.__dict__.values():
            if type(value) is list:
                if value and isinstance(value[0], ast.stmt):
                    found.bodies.append((node, value))
                stack.extend(v for v in value if isinstance(v, ast.AST))
            elif isinstance(value, ast.AST) and value._fields:
                stack.append(value)
    found.bodies.sort(key=lambda b: b[1][0].lineno)
    return found


# texts of a file


def docstrings(nodes: Nodes) -> Iterator[tuple[ast.AST | None, ast.Constant]]:
    """Yield each docstring with its module, class or function; with None where it describes the name assigned above it."""
    for node, body in nodes.bodies:
        documented = isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
        for i, statement in enumerate(body):
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant) and isinstance(statement.value.value, str):
                yield (node if documented and i == 0 else None), statement.value


COMMENT = re.compile(r"""("(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*')|#(.*)""")
DIRECTIVE = re.compile(r"\s*(type:|noqa|fmt:|pragma|mypy:|ruff:|!)")


def comments(text: str, nodes: Nodes) -> Iterator[tuple[int, str]]:
    """Yield each comment with its first line; comments on lines of their own, one after another, are one text."""
    lines = text.splitlines()
    quoted = {n for node in nodes.long for n in range(node.lineno, (node.end_lineno or node.lineno) + 1)}
    start = 0
    block: list[str] = []
    for number, line in enumerate([*lines, ""], 1):
        own = line.lstrip().startswith("#") and number not in quoted
        if own and not DIRECTIVE.match(line.lstrip()[1:]):
            start = start if block else number
            block.append(line.lstrip().lstrip("#"))
            continue
        if block:
            yield start, "\n".join(block)
            block = []
        if not own and "#" in line and number not in quoted:
            for match in COMMENT.finditer(line):
                if match[2] is not None and not DIRECTIVE.match(match[2]):
                    yield number, match[2]


SPOKEN = {"description", "help", "hint", "label", "placeholder", "title"}


def pieces_of(node: ast.expr) -> str:
    """Join the constant pieces of a string; what is put into it counts as one word."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(v.value if isinstance(v, ast.Constant) else "x" for v in node.values)  # type: ignore[misc]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return pieces_of(node.left) + pieces_of(node.right)
    return ""


def messages(nodes: Nodes) -> Iterator[tuple[int, str]]:
    """Yield the strings that errors are raised with, and those given as description, help, hint, label, placeholder or title."""
    given = [a for node in nodes.raised if isinstance(node.exc, ast.Call) for a in node.exc.args]
    given += [k.value for node in nodes.calls for k in node.keywords if k.arg in SPOKEN]
    for value in given:
        text = pieces_of(value)
        if " " in text:
            yield value.lineno, text


TAG = re.compile(r"</?(a|abbr|b|bdi|code|em|i|kbd|mark|q|s|small|span|strong|sub|sup|time|u|var)\b[^>]*>", re.IGNORECASE)
ATTRIBUTE = re.compile(r"""\b(?:title|placeholder|aria-label|alt)="([^"]*)\"""")


def template_texts(text: str) -> Iterator[tuple[int, str]]:
    """Yield the text nodes, the spoken attributes and the comments of a template; block tags and statements end a text."""

    def blank(match: re.Match[str]) -> str:
        return "\x00" + "\n" * match[0].count("\n")

    for match in re.finditer(r"\{#(.*?)#\}", text, re.DOTALL):
        yield text.count("\n", 0, match.start()) + 1, match[1]
    text = re.sub(r"\{#.*?#\}|<(script|style|svg)\b.*?</\1>|<!--.*?-->", blank, text, flags=re.DOTALL)
    text = re.sub(r"\{%.*?%\}", blank, text, flags=re.DOTALL)
    text = re.sub(r"\{\{.*?\}\}", lambda m: "x" + "\n" * m[0].count("\n"), text, flags=re.DOTALL)
    for match in ATTRIBUTE.finditer(text):
        yield from ((text.count("\n", 0, match.start()) + 1, part) for part in match[1].split("\x00") if " " in part.strip())
    text = re.sub(r"<[^>]+>", lambda m: "" if TAG.fullmatch(m[0]) else blank(m), text)
    line = 1
    for part in text.split("\x00"):
        if part.strip():
            yield line + len(part[: len(part) - len(part.lstrip())].splitlines()) - 1 if part[:1] == "\n" else line, part
        line += part.count("\n")


def document_texts(text: str) -> Iterator[tuple[int, str]]:
    """Yield the paragraphs, items and headings of a document, without code, tables, pictures and addresses."""

    def blank(match: re.Match[str]) -> str:
        return "\n" * match[0].count("\n")

    text = re.sub(r"^ *```.*?^ *```|<!--.*?-->", blank, text, flags=re.MULTILINE | re.DOTALL)
    start = 1
    block: list[str] = []
    for number, line in enumerate([*text.splitlines(), ""], 1):
        ends = not line.strip() or line.lstrip().startswith(("|", "#", "<", "!["))
        begins = re.match(r"\s*([*+-]|\d+\.)\s", line)
        if (ends or begins) and block:
            yield start, "\n".join(block)
            block = []
        if ends and not line.lstrip().startswith("#"):
            continue
        start = start if block else number
        block.append(re.sub(r"^\s*([*+-]|\d+\.|#+)\s", "", line))
        if ends:
            yield start, "\n".join(block)
            block = []


def texts_of(path: str) -> Iterator[Text]:
    """Yield the prose of a file."""
    if path.endswith(".py"):
        nodes = nodes_of(path)
        for _, constant in docstrings(nodes):
            yield Text(path, constant.lineno, str(constant.value))
        found = [*comments(source(path), nodes), *messages(nodes)]
    elif path.endswith(".html"):
        found = list(template_texts(source(path)))
    elif path.endswith(".md"):
        found = list(document_texts(source(path)))
    else:
        found = []
    yield from (Text(path, line, text) for line, text in found)
