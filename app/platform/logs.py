"""Logging: structlog for our own lines, the standard library's loggers at the same level.

Tracebacks are plain and hold no values of local variables: those may name a person, and drawing them takes tens of seconds.
"""

from __future__ import annotations

import logging
import sys
from contextlib import suppress
from typing import Any, TextIO, cast

import structlog

from app.settings import get_settings


def configure() -> None:
    """Set up logging of this process; lines go to standard error, so that commands keep standard output for results."""
    logging.basicConfig(level=_level(), stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    configure_own()


def configure_own() -> None:
    """Set up our own lines alone, as every service and every command does; other libraries' loggers stay as they are."""
    structlog.configure(
        wrapper_class=structlog.make_filtering_bound_logger(_level()),
        logger_factory=_to_standard_error,
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer() if get_settings().log_json else _console(),
        ],
    )


def _level() -> int:
    return logging.getLevelNamesMapping().get(get_settings().log_level.upper(), logging.INFO)


def _console() -> structlog.dev.ConsoleRenderer:
    return structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback)


def _to_standard_error(*_: Any) -> structlog.PrintLogger:
    """Log to standard error as it is when a line is written, so that a later redirection gets the lines too."""
    return structlog.PrintLogger(cast(TextIO, _Forgiving(sys.stderr)))


class _Forgiving:
    """A stream that loses lines where they cannot be written, as the standard library's loggers do. The log may be on a full disk. A caller
    who gets that message must not get an error of ours instead."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> None:
        with suppress(OSError):
            self._stream.write(text)

    def flush(self) -> None:
        with suppress(OSError):
            self._stream.flush()
