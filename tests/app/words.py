"""What a page says before anything is unfolded, and the words of methods that it does without there."""

from __future__ import annotations

import re
from html.parser import HTMLParser

BANNED = (
    "E[", "horizon", "logged", "saturated", "data support it", "DLSM", "DLMM", "FQE", "QoC", "ξβ", "xi_beta", "r_end", "posterior",
    "fitted Q", "Mean Q", "critic", "temporal-difference", "extrapolation", "Estimated return", "data do not support", "replay buffer",
    "decoded", "r_a", "r_b", "buffer", "from the seed", "cDBS = 1", "estimand", "off-policy",
)  # fmt: skip
_UNSEEN = {"details", "script", "style", "title", "head"}


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.folded, self.words = 0, []

    def handle_starttag(self, tag, attrs):  # type: ignore[no-untyped-def]
        # a fold that the page opens by itself is read
        self.folded += tag in _UNSEEN and not (tag == "details" and "open" in dict(attrs) and not self.folded)
        if not self.folded:
            self.words += [value for name, value in attrs if name in ("title", "aria-label", "placeholder") and value]

    def handle_endtag(self, tag):  # type: ignore[no-untyped-def]
        self.folded = max(0, self.folded - (tag in _UNSEEN))

    def handle_data(self, data):  # type: ignore[no-untyped-def]
        if not self.folded:
            self.words.append(data)


def above_fold(page: str) -> str:
    """The words of a page's HTML that no fold hides, figures included."""
    reader = _Reader()
    reader.feed(page)
    return " ".join(" ".join(reader.words).split())


def miscounted(words: str) -> list[str]:
    """Where some words speak of one minutes, or of one of any other thing of which there are counts."""
    return re.findall(rf"(?<![\d.,:/@\u202f-])\b1 (?:more |planned |further )?(?:{'|'.join(_COUNTED)})\b", words)


_COUNTED = (
    "minutes", "seconds", "days", "months", "visits", "sessions", "policies", "points", "percentage points", "participants", "files",
    "jobs", "rows", "intervals", "windows", "tests", "seeds", "logs", "revisions", "channels", "candidates",
)  # fmt: skip


def methods_named(words: str) -> list[str]:
    """The banned words among some words, whatever their capitals."""
    return [word for word in BANNED if word.lower() in words.lower()]
