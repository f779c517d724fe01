"""Pages of docs/results: what a benchmark printed, with the command and the commit that printed it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO, TextIOBase
from pathlib import Path
from typing import Any, TextIO

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
OPTION = "--write"


def emit(text: str) -> int:
    """Write a text to where prints go now: `run_benchmark` changes it."""
    return sys.stdout.write(text)


class _Both(TextIOBase):
    """Text that goes to a terminal and is kept."""

    def __init__(self, terminal: TextIO) -> None:
        self._terminal = terminal
        self.text = StringIO()

    def write(self, text: str) -> int:
        self._terminal.write(text)
        return self.text.write(text)

    def flush(self) -> None:
        self._terminal.flush()


def run_benchmark(main: Callable[[], Any], folder: Path = RESULTS) -> None:
    """Run a benchmark; with `--write NAME` keep what it prints as the page NAME of docs/results, which it replaces.

    A run that fails writes nothing.

    Raises:
        SystemExit: the name is missing, or is not made of small letters, digits and hyphens.
    """
    if OPTION not in sys.argv:
        if {"-h", "--help"} & set(sys.argv):
            print(f"{OPTION} NAME  also write what is printed to docs/results/NAME.md\n")
        main()
        return
    at = sys.argv.index(OPTION)
    name = sys.argv[at + 1] if at + 1 < len(sys.argv) else ""
    if not re.fullmatch(r"[a-z0-9][a-z0-9-]*", name):
        sys.exit(f"{OPTION} needs the name of a page in small letters, digits and hyphens, not {name!r}")
    command = " ".join([_program(), *sys.argv[1:]])
    del sys.argv[at : at + 2]
    both = _Both(sys.stdout)
    with redirect_stdout(both):
        main()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(page(name, command, both.text.getvalue()))


def page(name: str, command: str, text: str) -> str:
    """Lay out a page: heading, command, commit, machine, and the text as printed."""
    load = os.getloadavg()[0]
    machine = f"{os.cpu_count()} processors, a load of {load:.0f} at the end"
    title = name.replace("-", " ").capitalize()
    return f"# {title}\n\n`{command}` printed this at commit {_commit()}, on {machine}.\n\n```\n{text.strip()}\n```\n"


def _program() -> str:
    """Name the script as it is called from the root of the repository."""
    script = Path(sys.argv[0]).resolve()
    path = script.relative_to(ROOT) if script.is_relative_to(ROOT) else Path(script.name)
    module = sys.modules["__main__"].__spec__
    return f"python -m {module.name}" if module is not None and module.name.startswith("benchmarks.") else f"python {path}"


def _commit() -> str:
    """Read the commit of the checkout; changed files that are not committed are named as such."""
    answer = subprocess.run(["git", "describe", "--always", "--dirty=, with uncommitted changes"], cwd=ROOT, capture_output=True, text=True)
    return answer.stdout.strip() or "unknown"
