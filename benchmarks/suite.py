"""Cost of the test suite: processor and wall seconds of `make test`, and its twenty dearest tests.

    python benchmarks/suite.py                     of this checkout
    python benchmarks/suite.py . ../base           of two checkouts, one after the other, and the first as a share of the second
    python benchmarks/suite.py --quick             two small files of the suite

Processor seconds are user and system together, of every process that `make test` starts, PostgreSQL's and browsers' included. This process
adopts what lost its parent and waits for all of it. The seconds move with what else the machine does, so two checkouts are compared in one
call. `benchmarks/support/suite_costs/dear_tests.py` says what is counted to a test.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
from support.results import run_benchmark
from support.suite_costs.dear_tests import ADOPTER, COSTS

HERE = Path(__file__).resolve().parent
QUICK = "tests/app/accounts/test_permissions.py tests/test_compose.py"
DEAREST = 20
LEFT_FOR_S = 30.0
"""How long what the suite started may outlive it."""
_ADOPT = 36
"""PR_SET_CHILD_SUBREAPER of Linux's prctl."""


def children_s() -> float:
    """Sum the processor seconds of all children that were waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def wait_for_all() -> None:
    """Wait for every process that this one started or adopted; print and end what outlives the suite."""
    deadline = time.monotonic() + LEFT_FOR_S
    while psutil.Process().children():
        if time.monotonic() > deadline:
            for left in psutil.Process().children():
                print(f"left behind by the suite, and ended: {left.pid} {left.name()}", file=sys.stderr)
                left.kill()
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        time.sleep(0.1)


def reap_all_but(pid: int) -> None:
    """Take the end of adopted processes, as init would: a test waits until the server that it stopped is gone."""
    for child in psutil.Process().children():
        if child.pid != pid and child.status() == psutil.STATUS_ZOMBIE:
            os.waitpid(child.pid, os.WNOHANG)


def measure(checkout: Path, options: str) -> tuple[float, float, list[tuple[str, float]]]:
    """Measure processor and wall seconds of the suite of a checkout, and of each of its tests, the dearest first."""
    with tempfile.TemporaryDirectory() as costs:
        plugin = {"PYTEST_ADDOPTS": f"-p dear_tests {options}", "PYTHONPATH": str(HERE / "support" / "suite_costs")}
        env = os.environ | plugin | {COSTS: costs, ADOPTER: str(os.getpid())}
        before, begun = children_s(), time.monotonic()
        ended = subprocess.Popen(["make", "-s", "test"], cwd=checkout, env=env, stdout=sys.stderr)
        while ended.poll() is None:
            reap_all_but(ended.pid)
            time.sleep(0.1)
        wall_s = time.monotonic() - begun
        wait_for_all()
        if ended.returncode:
            print(f"the suite of {checkout} failed: its figures are of what ran", file=sys.stderr)
        tests = [tuple(json.loads(line)) for file in Path(costs).iterdir() for line in file.read_text().splitlines()]
        return children_s() - before, wall_s, sorted(tests, key=lambda test: -test[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", nargs="*", type=Path, default=[HERE.parent], help="one or two; this one where none is named")
    parser.add_argument("--quick", action="store_true", help="two small files of the suite, to see that the figures come")
    wanted = parser.parse_args()
    if len(wanted.checkouts) > 2:
        parser.error("name one checkout or two")
    ctypes.CDLL(None).prctl(_ADOPT, 1, 0, 0, 0)
    found = []
    for checkout in wanted.checkouts:
        cpu_s, wall_s, tests = measure(checkout, QUICK if wanted.quick else "")
        found.append((cpu_s, wall_s))
        print(f"{checkout.resolve()}: {len(tests)} tests, {cpu_s:.1f} s of processor, {wall_s:.1f} s of wall")
        for name, cost_s in tests[:DEAREST]:
            print(f"  {cost_s:6.2f} s  {name}")
    if len(found) == 2:
        (cpu_s, wall_s), (other_cpu_s, other_wall_s) = found
        print(f"ratio: {cpu_s / other_cpu_s:.3f} of processor, {wall_s / other_wall_s:.3f} of wall")


if __name__ == "__main__":
    run_benchmark(main)
