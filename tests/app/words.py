"""Words of a page before anything is unfolded, figures and scripts included, and the words of methods that must not be there."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from typing import Any

BANNED = (
    "E[", "horizon", "logged", "saturated", "data support it", "DLSM", "DLMM", "FQE", "QoC", "ξβ", "xi_beta", "r_end", "posterior",
    "fitted Q", "Mean Q", "critic", "temporal-difference", "extrapolation", "Estimated return", "data do not support", "replay buffer",
    "decoded", "r_a", "r_b", "buffer", "from the seed", "cDBS = 1", "estimand", "off-policy",
)  # fmt: skip
_UNSEEN = {"details", "script", "style", "title", "head"}
_DRAWN = {"text", "name", "title", "ticktext", "hovertemplate", "hovertext", "label", "labels", "x", "y"}
"""Members of a figure whose strings are drawn: titles, names in the legend, labels of axes, what a pointer shows, categories."""
_LITERAL = re.compile(
    r"""//[^\n]*|/\*.*?\*/|(?<=[(,=:[!&|?{};+\n ])/(?![/*\s])(?:\\.|\[(?:\\.|[^\]\\\n])*\]|[^/\\\n[])+/[a-z]*|"""
    r"""("(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'|`(?:\\.|[^`\\])*`)""",
    re.S,
)
"""Comments and patterns of a script, which no user reads, or (the group) a literal."""


def flat(page: str) -> str:
    """Return a page on one line, without white space between tags: where its template breaks lines means nothing."""
    return re.sub(r"> <", "><", re.sub(r"\s+", " ", page))


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.folded, self.words, self.figures, self.drawing = 0, [], [], False

    def handle_starttag(self, tag, attrs):  # type: ignore[no-untyped-def]
        named = dict(attrs)
        if tag == "script" and named.get("type") == "application/json" and not self.folded:
            self.figures.append(named.get("data-src") or "")
            self.drawing = not named.get("data-src")
        # a fold that the page opens by itself is read
        self.folded += tag in _UNSEEN and not (tag == "details" and "open" in named and not self.folded)
        if not self.folded:
            self.words += [value for name, value in attrs if name in ("title", "aria-label", "placeholder") and value]

    def handle_endtag(self, tag):  # type: ignore[no-untyped-def]
        self.folded = max(0, self.folded - (tag in _UNSEEN))
        self.drawing = False

    def handle_data(self, data):  # type: ignore[no-untyped-def]
        if self.drawing:
            self.figures[-1] += data
        elif not self.folded:
            self.words.append(data)


def above_fold(page: str) -> str:
    """Return the words of a page's HTML that no fold hides."""
    reader = _Reader()
    reader.feed(page)
    return " ".join(" ".join(reader.words).split())


def drawn_above_fold(page: str, fetch: Callable[[str], str]) -> str:
    """Return the words of the figures that no fold hides; `fetch` gives the figure of an address, for those not in the page."""
    reader = _Reader()
    reader.feed(page)
    figures = [json.loads(fetch(held) if held.startswith("/") else held) for held in reader.figures if held.strip()]
    return " | ".join(text for figure in figures for text in drawn(figure))


def drawn(figure: Any, shown: bool = False) -> Iterator[str]:
    """Yield the strings of a figure that users read."""
    if isinstance(figure, str):
        if shown:
            yield re.sub(r"%\{[^}]*\}", "", figure)
    elif isinstance(figure, list):
        for one in figure:
            yield from drawn(one, shown)
    elif isinstance(figure, dict):
        for name, value in figure.items():
            yield from drawn(value, name in _DRAWN)


def said_by_script(script: str) -> list[str]:
    """List the literals of a script that may reach a reader: those with a space or a capital, less what code alone is made of."""
    literals = [m[1][1:-1] for m in _LITERAL.finditer(script) if m[1]]
    texts = [re.sub(r"\$\{[^}]*\}", " ", text) for text in literals]
    return [text for text in texts if re.search(r"[A-Z ]", text)]


def miscounted(words: str) -> list[str]:
    """List where some words have the plural after 1, of minutes or of any other thing of which there are counts."""
    return re.findall(rf"(?<![\d.,:/@\u202f-])\b1 (?:more |planned |further )?(?:{'|'.join(_COUNTED)})\b", words)


_COUNTED = (
    "minutes", "seconds", "days", "months", "visits", "sessions", "policies", "points", "percentage points", "participants", "files",
    "jobs", "rows", "intervals", "windows", "tests", "seeds", "logs", "revisions", "channels", "candidates",
)  # fmt: skip


def methods_named(words: str) -> list[str]:
    """List the banned words among some words, whatever their capitals."""
    return [word for word in BANNED if word.lower() in words.lower()]
