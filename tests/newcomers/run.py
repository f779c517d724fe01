"""Run of all newcomers' machines: it prints their table, and compares it with the one in the docs.

As root, before anything is installed: `python3 -m tests.newcomers.run --work FOLDER --source REPOSITORY --suite CLONE`.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.newcomers.cases import LANES, Case, Ground
from tests.newcomers.machine import Fails, processes_naming

DOCS = Path(__file__).resolve().parents[2] / "docs" / "operations.md"
BEGIN, END = "<!-- newcomers: made by tests/newcomers/run.py -->\n", "<!-- newcomers: end -->"


def main() -> int:
    """Run the lanes side by side and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("work", "source", "suite"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--python", default=sys.executable, help="interpreter of root's machines")
    parser.add_argument("--write", action="store_true", help="put the table into the docs instead of comparing it")
    given = parser.parse_args()
    ground = Ground(given.work, given.source, given.suite, given.python, open_python(given.python))
    try:
        with ThreadPoolExecutor(len(LANES)) as lanes:
            done = lanes.map(lambda lane: [tried(case, ground) for case in lane], LANES)
            results = dict(pair for lane in done for pair in lane)
    finally:
        for number in processes_naming(given.work):  # of a failed case
            os.kill(number, signal.SIGKILL)
        for user in ground.users:
            remove_user(user)
    table = as_table({case: result for case, result in results.items() if result is not None})
    print(table)
    failed = [case.letter for case, result in results.items() if result is None]
    print(
        f"newcomers' machines: {len(results) - len(failed)} as they should be, {len(failed)} not: {', '.join(failed) or 'none'}", flush=True
    )
    if failed:
        return 1
    before, _, rest = DOCS.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    if given.write:
        DOCS.write_text(f"{before}{BEGIN}{table}{END}{after}")
    elif rest.partition(END)[0] != table:
        print(f"the table in {DOCS.name} is another one: write it with --write", flush=True)
        return 1
    return 0


def tried(case: Case, ground: Ground) -> tuple[Case, str | None]:
    """Try one case; None means a failure, whose words are printed."""
    begun = time.monotonic()
    try:
        result = case.try_it(ground)
    except Exception as error:
        words = str(error) if isinstance(error, Fails) else traceback.format_exc()
        print(f"({case.letter}) {case.machine}: FAILED after {time.monotonic() - begun:.0f} s\n{words}", flush=True)
        return case, None
    print(f"({case.letter}) {case.machine}: {result} ({time.monotonic() - begun:.0f} s)", flush=True)
    return case, result


def as_table(results: dict[Case, str]) -> str:
    """Return the results as a table in Markdown."""
    rows = [f"| {case.letter} | {case.machine} | {results[case]} |\n" for case in sorted(results, key=lambda case: case.letter)]
    return "| | machine | result |\n|---|---|---|\n" + "".join(rows)


def open_python(first: str) -> str:
    """Return an interpreter that every user may run and that makes virtual environments. Raises SystemExit where there is none."""
    check = "import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))"
    for python in (first, "/usr/bin/python3", "/usr/local/bin/python3"):
        # `env` looks the program up as that user; setpriv itself still does it with root's rights
        command = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "env", python, "-c", check]
        if subprocess.run(command, capture_output=True, cwd="/", check=False).returncode == 0:
            return python
    raise SystemExit("newcomers' machines need a Python 3.11 or newer with venv that every user may run, such as Debian's python3-venv.")


def remove_user(name: str) -> None:
    """Remove an ordinary user of this run, with the processes that are left of a failed case."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if entry.owner() == name:
                os.kill(int(entry.name), signal.SIGKILL)
        except (FileNotFoundError, ProcessLookupError, KeyError):
            continue
    time.sleep(0.5)
    subprocess.run(["userdel", name], check=True, capture_output=True)


if __name__ == "__main__":
    sys.exit(main())
