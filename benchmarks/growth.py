"""Growth of cost with the study: CPU seconds and memory of the three replaying methods as one participant has more sessions.

    python benchmarks/growth.py                            37, 111, 333 and 999 sessions; about four minutes
    python benchmarks/growth.py --quick                    37 and 111 sessions
    python benchmarks/growth.py --than CHECKOUT            the same of an older checkout, up to 333 sessions, and ratios to it

A monthly patient after 4, 12, 36 and 108 visits: 37 sessions of four visits, repeated. Each measurement is a process of its own with one
thread. It is fit and evaluation of 12 policies, after a first small fit that loads what is loaded once. Memory is the process's largest.
The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from support.results import run_benchmark

if TYPE_CHECKING:
    from ml.policies.policy import Policy
    from ml.trajectories import ReplayBuffer

METHODS = ("linear", "impulse", "posterior")
SIZES = (37, 111, 333, 999)
BASE = SIZES[0]
ROOT = Path(__file__).resolve().parents[1]


def record(sessions: int) -> ReplayBuffer:
    """Make so many sessions: those of four visits of P1, again and again at later visits."""
    from ml.population import random_controller_buffer

    first = random_controller_buffer("P1", 4, 9, 300, seed=1)
    kept = first.sessions[:BASE]
    found = []
    for k in range(sessions):
        turn, place = divmod(k, BASE)
        found.append(replace(kept[place], session_id=k + 1, visit=kept[place].visit + 4 * turn))
    return replace(first, sessions=tuple(found))


def candidates(xi: float) -> dict[str, Policy]:
    """Make twelve policies: constant amplitudes, and proportional ones about the threshold."""
    from ml.policies.policy import ConstantPolicy, ProportionalPolicy

    constant = {f"constant {a}": ConstantPolicy(a) for a in (0.4, 0.6, 0.8, 1.0)}
    floors = (0.2, 0.4, 0.6, 0.8)
    proportional = {
        f"from {low}, floor {floor}": ProportionalPolicy(low * xi, 1.2 * xi, floor, 5) for low in (0.7, 1.0) for floor in floors
    }
    return {**constant, **proportional}


def measure(method: str, sessions: int) -> dict[str, float]:
    """Measure CPU seconds of fit and evaluation, and the largest memory of this process, GiB."""
    from ml.ope.registry import estimators

    estimator = estimators(1)[method]
    policies = candidates(record(1).settings.xi_beta)
    few = record(6)
    estimator.fit(few).evaluate(dict(list(policies.items())[:1]))
    buffer = record(sessions)
    started = time.process_time()
    estimator.fit(buffer).evaluate(policies)
    seconds = time.process_time() - started
    return {"cpu_s": seconds, "memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20}


def measure_apart(checkout: Path, method: str, sessions: int) -> dict[str, float]:
    """Run `measure` in a process of its own.

    Raises:
        RuntimeError: the process failed; the message holds its last lines.
    """
    single = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [sys.executable, __file__, "--one", method, "--sessions", str(sessions)]
    ran = subprocess.run(command, env=os.environ | single | {"PYTHONPATH": str(checkout)}, cwd=checkout, capture_output=True, text=True)
    if ran.returncode:
        raise RuntimeError(f"{method} with {sessions} sessions in {checkout} failed:\n{ran.stderr[-2000:]}")
    return dict(json.loads(ran.stdout.splitlines()[-1]))


Table = dict[int, dict[str, dict[str, float]]]


def measure_growth(checkout: Path, sizes: tuple[int, ...]) -> Table:
    """Measure every method at every size; print a line for each size."""
    found: Table = {}
    for size in sizes:
        found[size] = {method: measure_apart(checkout, method, size) for method in METHODS}
        row = "".join(f"{found[size][m]['cpu_s']:>12.1f}" for m in METHODS)
        print(f"{size:>9}{row}{memory(found[size]):>12.2f}", flush=True)
    return found


def cpu(row: dict[str, dict[str, float]]) -> float:
    """Sum the CPU seconds of all methods."""
    return sum(found["cpu_s"] for found in row.values())


def memory(row: dict[str, dict[str, float]]) -> float:
    """Find the largest memory of a method, GiB."""
    return max(found["memory_gib"] for found in row.values())


def exponent(table: Table) -> float:
    """Compute the power of the number of sessions by which CPU time grows over the last two sizes."""
    small, large = sorted(table)[-2:]
    return math.log(cpu(table[large]) / cpu(table[small])) / math.log(large / small)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="37 and 111 sessions alone")
    parser.add_argument("--than", type=Path, metavar="CHECKOUT", help="folder of an older checkout to measure as well")
    parser.add_argument("--one", choices=METHODS, help=argparse.SUPPRESS)
    parser.add_argument("--sessions", type=int, default=BASE, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(arguments.one, arguments.sessions)))
        return
    if arguments.than is not None and not (arguments.than / "ml").is_dir():
        parser.error(f"{arguments.than} is no checkout: it has no folder ml")
    sizes = SIZES[:2] if arguments.quick else SIZES
    print(f"{'sessions':>9}" + "".join(f"{m + ', s':>12}" for m in METHODS) + f"{'GiB':>12}")
    now = measure_growth(ROOT, sizes)
    figures: dict[str, Any] = {f"{m}_cpu_s_{n}": round(found["cpu_s"], 2) for n, row in now.items() for m, found in row.items()}
    figures |= {f"memory_gib_{n}": round(memory(row), 2) for n, row in now.items()}
    figures["exponent"] = round(exponent(now), 2)
    ratios: dict[str, float] = {}
    if 333 in now:
        ratios["cpu_37_to_333"] = round(cpu(now[333]) / cpu(now[BASE]), 2)
    if arguments.than is not None:
        print(f"{arguments.than}:")
        then = measure_growth(arguments.than.resolve(), tuple(n for n in sizes if n <= 333))
        ratios |= {f"cpu_ratio_{n}": round(cpu(now[n]) / cpu(row), 4) for n, row in then.items()}
        ratios |= {f"memory_ratio_{n}": round(memory(now[n]) / memory(row), 4) for n, row in then.items()}
    print(json.dumps({"name": "growth", "figures": figures, "ratios": ratios} | ratios))


if __name__ == "__main__":
    run_benchmark(main)
