"""Rules of plain English: sentences, first words, private words, names, and subjects of commits.

The words of the rules are in words.toml. `python -m tests.architecture.prose [path or rule ...]` lists the breaches.
"""

from __future__ import annotations

import ast
import re
import subprocess
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from tests.architecture.texts import ROOT, Nodes, docstrings, nodes_of, texts_of, tracked_files

WORDS = tomllib.loads((Path(__file__).parent / "words.toml").read_text())
LONGEST = 25
"""Words that a sentence may have."""
LONGEST_SUBJECT = 72
"""Characters that the subject of a commit may have."""
RULES = ("long sentences", "first words", "banned words", "names")


class Finding(NamedTuple):
    """A breach of a rule: which rule, where, and the words it is about."""

    rule: str
    path: str
    line: int
    about: str

    @property
    def folder(self) -> str:
        """Top-level folder of the file; `.` for files of the root."""
        return self.path.partition("/")[0] if "/" in self.path else "."


# sentences


def plain(text: str) -> str:
    """Take markup, code and addresses out of a text; each leaves one word."""
    text = re.sub(r"`[^`]*`", "x", text.replace("held out", "held-out"))
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"\bhttps?://\S+", "x", text)
    return re.sub(r"\*\*|__|&[a-z]+;", " ", text)


ABBREVIATION = re.compile(r"\b(e\.g|i\.e|vs|cf|al|eq|fig|no|nos|approx|resp|pp|p|sec|ch|dr|st)\.$", re.IGNORECASE)
SECTION = re.compile(r"^\s*(Args|Attributes|Returns|Raises|Yields|Example|Examples|Note|Notes|References):\s*$")


def fragments(text: str) -> Iterator[str]:
    """Yield paragraphs: an empty line, an item, a section or an entry of a section ends one; lines of code and tables are left away."""
    block: list[str] = []
    entries: int | None = None
    for line in [*text.splitlines(), ""]:
        indent = len(line) - len(line.lstrip())
        code = (
            line.lstrip().startswith((">>>", "...")) or bool(re.search(r"\S {2,}\S|\S\s*[│─▶◀┐└┘├]", line)) or line.lstrip().startswith("|")
        )
        if SECTION.match(line):
            entries = indent + 4
        elif entries is not None and line.strip() and indent < entries:
            entries = None
        begins = bool(re.match(r"\s*([*+-]|\d+[.)])\s", line)) or (entries == indent and bool(line.strip())) or bool(SECTION.match(line))
        if (not line.strip() or code or begins) and block:
            yield " ".join(block)
            block = []
        if line.strip() and not code and not SECTION.match(line):
            block.append(line.strip())


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of a text."""
    for fragment in fragments(plain(text)):
        rest = ""
        for part in re.split(r"(?<=[.!?])[)\"'”]*\s+(?=[\"'“(]*[A-Z0-9x])", fragment):
            rest = f"{rest} {part}".strip()
            if not ABBREVIATION.search(rest):
                yield rest
                rest = ""
        if rest:
            yield rest


def word_count(sentence: str) -> int:
    """Count the words: what has a letter and no sign of a formula."""
    return sum(bool(re.search(r"[^\W\d_]", w)) and not re.search(r"[=<>{}\[\]\\^|_]", w) for w in sentence.split())


# rules


BANNED = re.compile(
    r"(?<![\w-])(" + "|".join(sorted(map(re.escape, WORDS["banned"]), key=len, reverse=True)) + r")(?![\w-])", re.IGNORECASE
)
QUESTION = {"how", "that", "what", "when", "where", "whether", "which", "who", "whom", "whose", "why"}
DETERMINER = {"a", "all", "an", "any", "each", "every", "its", "one", "that", "the", "their", "this", "what", "whether", "which"}


def verbs() -> frozenset[str]:
    """Read the verbs that docstrings of functions may begin with."""
    return frozenset(WORDS["verbs"]["base"])


def wrong_first_word(node: ast.AST, text: str) -> bool:
    """Decide whether a docstring begins otherwise than it should.

    A function begins with a verb that no "of" makes a noun. A class, a module, a property or a fixture begins with its noun: with no
    question word, and with no verb before a determiner. Tests are sentences, so that their docstrings are free.
    """
    words = re.findall(r"[^\s,.:;]+", text.strip())[:2]
    first, second = [*words, "", ""][:2]
    if first.lower() in QUESTION:
        return True
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and not is_noun(node):
        return not node.name.startswith("test_") and (first.lower() not in verbs() or second == "of")
    return first.lower() in verbs() and second.lower() in DETERMINER


def is_noun(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Decide whether a function is used as a value: a property or a fixture."""
    return any(re.search(r"\b(\w*property|fixture|setter)\b", ast.unparse(d)) for d in function.decorator_list)


def wrong_name(name: str) -> bool:
    """Decide whether a name is a participle or a preposition alone."""
    name = name.strip("_")
    if "_" in name or not name.islower():
        return False
    return name in WORDS["names"]["alone"] or (name.endswith("ed") and len(name) > 3 and name not in WORDS["names"]["ending"])


def names_in(nodes: Nodes) -> Iterator[tuple[int, str]]:
    """Yield the names of functions, methods and parameters; what is true or false may be a participle and is left away."""
    for node in nodes.functions:
        if node.returns is None or ast.unparse(node.returns) != "bool":
            yield node.lineno, node.name
        for argument in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs):
            if argument.annotation is None or not re.match(r"bool\b", ast.unparse(argument.annotation)):
                yield argument.lineno, argument.arg


def findings_of(path: str) -> Iterator[Finding]:
    """Yield every breach of a rule in a file."""
    for text in texts_of(path):
        for sentence in sentences(text.text):
            if sentence.count(" ") >= LONGEST and word_count(sentence) > LONGEST:
                yield Finding("long sentences", path, text.line, f"{word_count(sentence)} words: {sentence}")
        for match in BANNED.finditer(plain(text.text)):
            yield Finding("banned words", path, text.line, f"{match[0]}: {WORDS['banned'][match[0].lower()]}")
    if not path.endswith(".py"):
        return
    for node, constant in docstrings(nodes_of(path)):
        if node is not None and wrong_first_word(node, str(constant.value)):
            yield Finding("first words", path, constant.lineno, str(constant.value).strip().split("\n")[0])
    for line, name in [(1, Path(path).stem), *names_in(nodes_of(path))]:
        if wrong_name(name):
            yield Finding("names", path, line, name)


@cache
def findings() -> tuple[Finding, ...]:
    """Collect every breach of a rule in the repository."""
    return tuple(f for path in tracked_files() if path.endswith((".py", ".html", ".md")) for f in findings_of(path))


def counts(breaches: Iterable[Finding]) -> dict[str, dict[str, int]]:
    """Count breaches by rule and top-level folder; what is 0 is left away."""
    table = Counter((f.rule, f.folder) for f in breaches)
    return {rule: {folder: n for (r, folder), n in sorted(table.items()) if r == rule} for rule in RULES}


# subjects of commits


def subjects(base: str) -> list[str] | None:
    """List the subjects of the commits after a base, without merges; None where that commit is not known, as in an unpacked archive."""
    log = ["git", "log", "--no-merges", "--format=%s", f"{base}..HEAD"]
    answer = subprocess.run(log, cwd=ROOT, capture_output=True, text=True)
    return answer.stdout.splitlines() if answer.returncode == 0 else None


def wrong_subject(subject: str) -> str | None:
    """Name what is wrong with the subject of a commit, or nothing."""
    first = subject.split(" ")[0]
    if len(subject) > LONGEST_SUBJECT:
        return f"{len(subject)} characters"
    if first in WORDS["subjects"]["first"] or not first[:1].isupper():
        return "begins with no verb"
    if first.lower() not in verbs() and re.fullmatch(r"\w+(ed|ing)|\w*[^\Ws]s", first):
        return "is no imperative"
    match = BANNED.search(plain(subject))
    return f"says {match[0]}" if match else None


if __name__ == "__main__":
    import sys

    chosen = sys.argv[1:]
    for finding in findings():
        if not chosen or any(finding.path.startswith(c) or finding.rule == c for c in chosen):
            print(f"{finding.path}:{finding.line}: {finding.rule}: {finding.about}")  # noqa: T201
