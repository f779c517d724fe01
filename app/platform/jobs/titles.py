"""Titles and messages of steps for all readers, without names of methods.

The stored title names the method, for engineers: their folds and the interface give it as it is.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence

from app.tables.jobs import Job, JobStatus, JobStep

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

_OF_A_STEP = re.compile(r"Step (?P<key>\S+) failed: (?P<message>.*)", re.S)
"""As `StepFailed` words what ended a job."""
_UNFORESEEN = re.compile(r"\A[A-Za-z_]\w*(?:: |\Z)|\b\w+(?:Error|Exception)\b")
"""Text of an error that is not our own (`app.platform.jobs.steps.worded`): it begins with the name of its class, or contains one."""


def plain_words(text: str) -> str:
    """Remove names of methods from a step's title, its message, or both (`title: message`)."""
    for stored, plain in _PLAIN:
        text = stored.sub(plain, text)
    return text


def numbered(titles: Sequence[str]) -> list[str]:
    """Return the plain titles of a job's steps; those that differ only by method are counted: `..., method 2 of 5`."""
    plain = [plain_words(title) for title in titles]
    of, seen = Counter(plain), Counter[str]()
    shown = []
    for title in plain:
        seen[title] += 1
        shown.append(f"{title}, method {seen[title]} of {of[title]}" if of[title] > 1 else title)
    return shown


def reason(message: str) -> str:
    """Return our own error's text without names of methods; nothing of any other error, which only engineers can read."""
    return "" if _UNFORESEEN.search(message) else plain_words(message)


def failure(error: str, titles: Mapping[str, str] | None = None) -> str:
    """Explain to readers of results why a job or a step failed: our own errors in their words; for others, which step it was.

    The stored text names classes and methods, for engineers: their fold and the interface give it as it is.

    Args:
        error: as it is stored. titles: plain titles of the job's steps by key; without them no step is named.
    """
    step = _OF_A_STEP.fullmatch(error)
    if said := reason(step["message"] if step else error):
        return said
    title = (titles or {}).get(step["key"]) if step else None
    return f"A step failed: {title}." if title else "A step failed." if step else "It failed for a reason that is told to engineers."


def state_in_words(work: Job | JobStep) -> str:
    """Say what a job or a step does now, or why it failed, without names of methods.

    Returns:
        Words for a page; nothing where a step failed for a reason that engineers alone can read.
    """
    if work.status != JobStatus.FAILED:
        return plain_words(work.message)
    if isinstance(work, JobStep):
        return reason(work.message)
    return failure(work.message) if work.message else ""
