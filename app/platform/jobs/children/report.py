"""Reports of a compute function while it works: progress, learning-curve points and log lines, as JSON lines on a pipe."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ml.progress import Report

INTERVAL_S = 0.2
"""At most one line per this many seconds; points in between are sent together, of progress the latest is sent."""


class StepReport:
    """Handed to every compute function.

    Args:
        send: takes one message; tests and scripts pass a list's `append`.
        interval_s: least time between messages, seconds.
    """

    def __init__(self, send: Callable[[dict[str, Any]], None], interval_s: float = INTERVAL_S) -> None:
        self._send = send
        self._interval_s = interval_s
        self._last = -math.inf
        self._fraction: float | None = None
        self._message: str | None = None
        self._points: list[dict[str, Any]] = []

    def progress(self, fraction: float, message: str | None = None) -> None:
        """Say how much of this step is done, 0 to 1, and in a few words what is going on.

        Raises:
            ValueError: the fraction is no number.
        """
        if math.isnan(fraction):
            raise ValueError("progress must be a number between 0 and 1, not NaN")
        self._fraction = min(max(float(fraction), 0.0), 1.0)
        if message is not None:
            self._message = message
        self._maybe_send()

    def point(self, x: float, **values: float) -> None:
        """Add one point to the learning curves named by the keywords; after a resumed step the last point of an x counts.

        A value that is no finite number is omitted (JSON has none), as a gap in its curve.
        """
        finite = {name: float(value) for name, value in values.items() if math.isfinite(value)}
        self._points.append({"x": float(x), "values": finite})
        self._maybe_send()

    def curves(self, x_end: float, prefix: str = "") -> Report:
        """Wrap this report for a computation of `ml`: fractions become progress, numbers points of learning curves from 0 to `x_end`."""

        def report(fraction: float, message: str = "", **numbers: float) -> None:
            self.progress(fraction, message or None)
            if numbers:
                self.point(round(fraction * x_end, 6), **{prefix + name: value for name, value in numbers.items()})

        return report

    def log(self, text: str) -> None:
        """Add a line to the job's log at once."""
        self.flush()
        self._send({"log": text})

    def flush(self) -> None:
        """Send what waits."""
        message: dict[str, Any] = {}
        if self._fraction is not None:
            message["progress"] = self._fraction
        if self._message is not None:
            message["message"] = self._message
        if self._points:
            message["points"] = self._points
        if message:
            self._send(message)
        self._fraction, self._message, self._points = None, None, []
        self._last = time.monotonic()

    def _maybe_send(self) -> None:
        if time.monotonic() - self._last >= self._interval_s:
            self.flush()


def pipe_sender(fd: int) -> Callable[[dict[str, Any]], None]:
    """Return a `send` that writes JSON lines to a file descriptor."""
    pipe = os.fdopen(fd, "w", encoding="utf-8", buffering=1)

    def send(message: dict[str, Any]) -> None:
        pipe.write(json.dumps(message, allow_nan=False) + "\n")
        pipe.flush()

    return send


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that a kill at any moment leaves the old file or the whole new one; only its owner reads it."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as out:
        out.write(content)
        out.flush()
        os.fsync(out.fileno())
    draft.replace(path)
