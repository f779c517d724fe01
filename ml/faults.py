"""Separation of errors that our own code raises about data from those that a library raises about its arrays."""

from __future__ import annotations

import traceback
from collections.abc import Callable

_OURS = ("app", "ml")
BROKE = "its computation broke down on these data; the log tells engineers where"


def own_words(error: Exception) -> str | None:
    """Return the message of an error that our own code raised, as a sentence for people who read results; None where a library raised it.

    What is raised by a function written in C counts as the code that called it.
    """
    frame = error.__traceback__
    while frame is not None and frame.tb_next is not None:
        frame = frame.tb_next
    home = str(frame.tb_frame.f_globals.get("__name__", "")) if frame is not None else ""
    of_a_library = type(error) is not ValueError and type(error).__module__.partition(".")[0] not in _OURS
    return None if of_a_library or home.partition(".")[0] not in _OURS else str(error)


def said_of(error: Exception, log: Callable[[str], None]) -> str:
    """Say why a method gave nothing, for people who read results; a library's message goes to `log`."""
    if (said := own_words(error)) is not None:
        return said
    log("".join(traceback.format_exception(error)).rstrip())
    return BROKE
