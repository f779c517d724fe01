"""Formatter of the page templates: it breaks long lines where neither Jinja nor HTML takes notice.

List the lines that are too long: `python -m tests.architecture.templates`. Break them: `python -m tests.architecture.templates --write`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, nodes

WIDTH = 140
"""Characters of a line, as in the code."""

FOLDER = Path(__file__).resolve().parents[2] / "app" / "templates"

_BLOCK_TAGS = (
    "p|li|ul|ol|tr|td|th|thead|tbody|tfoot|table|caption|dl|dt|dd|h[1-6]|div|section|article|header|footer|nav|form|fieldset|option|details"
    "|summary|script"
)
_CLOSED = re.compile(rf"</(?:{_BLOCK_TAGS})>$")
_AFTER_CLOSED = re.compile(rf"(</(?:{_BLOCK_TAGS})>)\s+")
_VERBATIM = re.compile(r"<(/?)(pre|textarea|script|style)\b", re.IGNORECASE)
_raw = Environment(keep_trailing_newline=True, autoescape=True)  # keeps white space as it is written
_rendering = Environment(trim_blocks=True, lstrip_blocks=True, autoescape=True)  # as pages are rendered


@dataclass(frozen=True)
class Break:
    """Place for a line break: characters `begin` to `end` of the source give way to a new line that begins with `indent` spaces.

    Attributes:
        cost: how unwelcome the break is, in characters of an unused line.
    """

    begin: int
    end: int
    indent: int
    cost: float


def reformat(source: str) -> str:
    """Return the template with its long lines broken, as far as there are places for it."""
    while True:
        taken = _next_break(source)
        if taken is None:
            return source
        source = source[: taken.begin] + "\n" + " " * taken.indent + source[taken.end :]


def meaning(source: str) -> str:
    """Return what Jinja compiles a template to, with white space of the page reduced to what a browser shows."""
    tree = _rendering.parse(source)
    for data in tree.find_all(nodes.TemplateData):
        data.data = _AFTER_CLOSED.sub(r"\1", re.sub(r"\s+", " ", data.data))
    for output in tree.find_all(nodes.Output):
        output.nodes = [node for node in output.nodes if not isinstance(node, nodes.TemplateData) or node.data]
    return re.sub(r"Output\(nodes=\[\]\),? ?", "", repr(tree))


def _next_break(source: str) -> Break | None:
    """Find the best break within the first line that is too long and can be broken."""
    places: dict[int, list[Break]] = {}
    starts = [0] + [found.end() for found in re.finditer("\n", source)]
    line_of = {}
    for number, start in enumerate(starts):
        line_of[number] = (start, source.find("\n", start) if source.find("\n", start) >= 0 else len(source))
    long = [number for number, (begin, end) in line_of.items() if end - begin > WIDTH]
    if not long:
        return None
    every = sorted(_breaks(source), key=lambda place: place.begin)
    for number in long:
        begin, end = line_of[number]
        places[number] = [place for place in every if begin < place.begin and place.end < end and source[begin : place.begin].strip()]
        fitting = [place for place in places[number] if place.begin - begin <= WIDTH]
        if fitting:
            return min(fitting, key=lambda place: place.cost + WIDTH - (place.begin - begin))
        if places[number]:
            return places[number][0]
    return None


def _breaks(source: str) -> Iterator[Break]:
    """Yield the places where a line may be broken."""
    position, depth, before = 0, 0, ""
    html = _Html()
    tokens = list(_raw.lex(source))
    for k, (_, kind, text) in enumerate(tokens):
        begin = source.index(text, position)  # the lexer leaves out white space that a minus strips
        position = begin + len(text)
        line = source.rfind("\n", 0, begin) + 1
        indent = len(source[line:]) - len(source[line:].lstrip(" "))
        following = source[position : position + 1]
        if kind == "data":
            yield from html.breaks(text, begin, indent, after_block=before in ("block_end", "comment_end"))
        elif kind == "whitespace" and "\n" not in text and tokens[k - 1][1] not in ("block_begin", "variable_begin"):
            if tokens[k + 1][1] not in ("block_end", "variable_end"):
                yield Break(begin, position, indent + 2, 45 + 15 * depth + (30 if before == "name" else 0))
        elif kind == "operator" and text in "([{":
            depth += 1
        elif kind == "operator" and text in ")]}":
            depth -= 1
        elif kind == "block_end" and not following.isspace() and not html.verbatim:
            yield Break(position, position, 0, 30 if html.inside else 10)
        if kind != "whitespace":
            before = kind


class _Html:
    """Place in the HTML that the data of a template make, so far.

    Attributes:
        inside: within a tag.
        verbatim: element whose white space counts, or empty.
    """

    def __init__(self) -> None:
        self.inside = False
        self.quote = ""
        self.verbatim = ""

    def breaks(self, text: str, offset: int, indent: int, *, after_block: bool) -> Iterator[Break]:
        """Yield the places of one piece of text. Remember which elements it opens and closes."""
        k = 0
        while k < len(text):
            if not self.inside and (found := _VERBATIM.match(text, k)):
                self.verbatim = "" if found[1] else found[2]
            letter = text[k]
            if self.quote:
                self.quote = "" if letter == self.quote else self.quote
            elif self.inside and letter in "\"'":
                self.quote = letter
            elif letter == "<" and re.match(r"[/a-zA-Z!]", text[k + 1 : k + 2]):
                self.inside = True
            elif letter == ">" and self.inside:
                self.inside = False
                if not self.verbatim and _CLOSED.search(text[: k + 1]) and k + 1 < len(text) and not text[k + 1].isspace():
                    yield Break(offset + k + 1, offset + k + 1, indent, 0)
            elif letter.isspace() and not (self.verbatim and not self.inside):
                end = k + len(text[k:]) - len(text[k:].lstrip())
                named = self.inside and re.search(r"</?[a-zA-Z][\w-]*$", text[:k])  # an element's name keeps its first attribute
                if "\n" not in text[k:end] and not (k == 0 and after_block) and not named:
                    yield Break(offset + k, offset + end, indent + 2 * self.inside, 150 if self.inside else 130)
                k = end - 1
            k += 1


def main() -> int:
    """List or break the lines that are too long."""
    write = "--write" in sys.argv
    for path in sorted(FOLDER.rglob("*.html")):
        source = path.read_text()
        result = reformat(source)
        if meaning(result) != meaning(source):
            raise SystemExit(f"{path}: breaking its lines would change the page; nothing was written to it")
        if result != source:
            print(path.relative_to(FOLDER))  # noqa: T201
            if write:
                path.write_text(result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
