"""Common part of the commands of every phase: options, who acts, and how they answer."""

from __future__ import annotations

import json
import sys
from typing import Annotated, Any

import typer

AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Code = Annotated[str, typer.Argument(help="Code of the participant, e.g. P1.")]
Why = Annotated[str, typer.Option("--reason", help="Why; kept in the audit trail.", callback=lambda text: _check_reason(text))]
ACTOR = "command line"


def _check_reason(text: str) -> str:
    """Check a reason, without blanks around it."""
    if not 1 <= len(text.strip()) <= 1000:
        raise typer.BadParameter("say why, in 1 to 1000 characters")
    return text.strip()


def show(result: Any, as_json: bool, text: str) -> None:
    """Show the answer of a command: its result as one line of JSON, or in words."""
    print_line(json.dumps(result, default=str) if as_json else text)


def print_line(text: str) -> None:
    """Print the answer of a command that has words alone."""
    print(text)  # noqa: T201


def say(text: str) -> None:
    """Print a line to standard error: what went wrong."""
    print(text, file=sys.stderr)  # noqa: T201


def bad_call(text: str) -> typer.Exit:
    """Say in a line what is wrong with the call; to be raised."""
    say(f"betaloop: {text}")
    return typer.Exit(2)


def reason(error: Exception) -> str:
    """Explain why a file could not be read or written, without its path."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
