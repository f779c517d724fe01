"""What a step is called where anybody reads it: its title and messages without names of methods, also those that earlier versions stored.

The stored title names the method, for engineers: their folds and the interface give it as it is.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

_PLAIN: tuple[tuple[re.Pattern[str], str], ...] = tuple(
    (re.compile(stored), plain)
    for stored, plain in (
        ("Take a buffer snapshot", "Pin the sessions to learn from"),
        (r"Estimate every policy: [^:]+", "Estimate every policy"),
        (r"Fit the deep latent sequential model, member (\d+)", r"Fit model \1 of the sessions"),
        (r"((?:Train|Fine-tune) polic[^(:]*?) \([^)]*\)", r"\1"),
        (r"fitting the (?:deep latent [A-Za-z]+|linear) model", "fitting the model"),
        (r" in the (?:deep latent [A-Za-z]+|linear) model", " in the model"),
        (r"densities of the logged amplitudes", "weighing the recorded amplitudes"),
        (r"(?:fitting|inputs of the) density ratios", "weighing sessions"),
        (r"(?:evaluating|correcting) value functions|choosing the penalty of the value function", "estimating policies"),
    )
)


def plain_words(text: str) -> str:
    """A step's title, its message, or both (`title: message`), without names of methods."""
    for stored, plain in _PLAIN:
        text = stored.sub(plain, text)
    return text


def numbered(titles: Sequence[str]) -> list[str]:
    """The plain titles of a job's steps; those that differ by their method alone are counted: `..., method 2 of 5`."""
    plain = [plain_words(title) for title in titles]
    of, seen = Counter(plain), Counter[str]()
    shown = []
    for title in plain:
        seen[title] += 1
        shown.append(f"{title}, method {seen[title]} of {of[title]}" if of[title] > 1 else title)
    return shown
