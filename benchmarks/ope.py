"""Off-policy evaluation against known returns, over the worlds of a virtual population.

    python benchmarks/ope.py --quick                          three worlds of part A, few simulated sessions
    python benchmarks/ope.py --part A --out FOLDER            60 worlds, data by both designs; resumable
    python benchmarks/ope.py --part B --out FOLDER            the same to report on; each run is counted in looks.json

Nothing is fitted or chosen by true returns; they are computed to measure with. Finished cells are lines of FOLDER/cells-*.jsonl, and a run
that is started again skips them. CPU seconds of one thread. `days alone` is a perfect
method that knows the days of the data and no others; `tested` tests the candidates themselves in as many sessions as the data hold.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from support.cells import Cells
from support.looks import LookError, look, said
from support.ope_cases import CDBS, DESIGNS, MATCHED, Case, virtual_case
from support.ope_report import figures, report
from support.results import run_benchmark

from ml.ope.compare.gain import gain_over
from ml.ope.estimate import Estimate, Estimator
from ml.ope.registry import POSTERIOR, estimators
from ml.population.virtual import WORLDS_PER_PART
from ml.population.virtual.world import STEPS

HEADLINE = POSTERIOR
CHEAP = (POSTERIOR, "linear", "impulse", "fqe", "wdr", "dlmm", "pdis", "wis", "cwpdis")
DEAR = ("dlsm", "dual_dice")
DLSM_EVERY = 6
"""The DLSM and DualDICE run on every sixth world: they cost more than all others together."""
QUICK_WORLDS, QUICK_TRUTH, TRUTH = 3, 80, 300


@dataclass(frozen=True)
class Task:
    """One world to measure, with the cells that are known of it."""

    name: str
    truth_sessions: int
    methods: tuple[str, ...]
    designs: tuple[str, ...]
    known: Mapping[str, Any]


def measure(task: Task) -> list[dict[str, Any]]:
    """Measure all cells of one task that are not known yet."""
    torch.set_num_threads(1)
    cells: list[dict[str, Any]] = []
    truth = task.known.get(f"{task.name}/truth")
    case = virtual_case(task.name[0], int(task.name[1:]), task.truth_sessions, truth)
    if truth is None:
        cells.append({"key": f"{task.name}/truth", **case.truth})
    for design in task.designs:
        wanted = tuple(m for m in task.methods if f"{task.name}/{design}/{m}" not in task.known)
        if wanted:
            cells += design_cells(case, design, wanted)
    return cells


def design_cells(case: Case, design: str, methods: tuple[str, ...]) -> list[dict[str, Any]]:
    """Fit and evaluate each method; one cell a method."""
    buffer, policies = case.data(design), {**case.candidates, **case.probes}
    chosen = {m: e for m, e in estimators(0, demo=True).items() if m in methods}
    return [_method_cell(case, design, method, estimator, buffer, policies) for method, estimator in chosen.items()]


def _method_cell(case: Case, design: str, method: str, estimator: Estimator, buffer: Any, policies: Any) -> dict[str, Any]:
    start = time.process_time()
    try:
        table = estimator.fit(buffer).evaluate(policies, STEPS)
    except ValueError as error:
        return {"key": f"{case.name}/{design}/{method}", "failed": str(error), "seconds": time.process_time() - start}
    return {"key": f"{case.name}/{design}/{method}", **_measures(case, table), "seconds": time.process_time() - start}


def _measures(case: Case, table: Mapping[str, Estimate]) -> dict[str, Any]:
    """Extract what is measured of a method's estimates: those of the candidates, and its answers to sustained dose and to following
    beta."""
    dose = gain_over(table[case.low], table[CDBS])
    follow = gain_over(table[case.follows], table[MATCHED])
    return {
        "estimates": {
            n: {"value": table[n].value, "low": table[n].low, "high": table[n].high, "supported": table[n].supported}
            for n in case.candidates
        },
        "dose": [dose.low, dose.high],
        "follow": [follow.low, follow.high],
    }


def tasks(chosen: argparse.Namespace, cells: Cells) -> list[Task]:
    """List the tasks in order."""
    without = chosen.without.split(",")
    methods = tuple(m for m in CHEAP if m not in without)
    dear = tuple(m for m in DEAR if m not in without)
    result = []
    for index in range(chosen.first, WORLDS_PER_PART, chosen.every)[: chosen.worlds]:
        name = f"{chosen.part}{index:02d}"
        known = {cell["key"]: cell for cell in cells.all(f"{name}/")}
        all_methods = (*dear, *methods) if chosen.dlsm and index % DLSM_EVERY == 0 else methods
        result.append(Task(name, chosen.truth, all_methods, DESIGNS, known))
    return result


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=("A", "B", "C"), default="A", help="A to develop on, B to report on, C once before a release")
    parser.add_argument("--release", help="the release that a run of part C belongs to")
    parser.add_argument("--quick", action="store_true", help="three worlds, few simulated sessions, no DLSM or DualDICE")
    parser.add_argument("--worlds", type=int, default=WORLDS_PER_PART)
    parser.add_argument("--first", type=int, default=0, help="index of the first world")
    parser.add_argument("--without", default="", help="methods to exclude, with commas")
    parser.add_argument(
        "--no-dlsm", dest="dlsm", action="store_false", help=f"else the DLSM and DualDICE run on every {DLSM_EVERY}th world"
    )
    parser.add_argument("--every", type=int, default=1, help="take every so manyth world")
    parser.add_argument("--headline", default=HEADLINE, help="the method that the figures of the last line are of")
    parser.add_argument("--truth", type=int, help=f"simulated sessions behind each true return; {TRUTH}, {QUICK_TRUTH} with --quick")
    parser.add_argument("--minutes", type=float, default=1e9, help="start no further world after so many minutes")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder of the cells and of ope.svg; a temporary one by default")
    chosen = parser.parse_args()
    chosen.truth = chosen.truth or (QUICK_TRUTH if chosen.quick else TRUTH)
    if chosen.quick:
        chosen.worlds, chosen.dlsm = min(chosen.worlds, QUICK_WORLDS), False
    return chosen


def run(planned: list[Task], cells: Cells, processes: int, minutes: float) -> None:
    """Measure the tasks, as many at a time as there are processes; cells are written as they come."""
    start = time.monotonic()
    size = max(1, processes)
    with ProcessPoolExecutor(size) as pool:
        for k in range(0, len(planned), size):
            if time.monotonic() - start > 60 * minutes:
                break
            for task, found in zip(planned[k : k + size], pool.map(measure, planned[k : k + size]), strict=True):
                for cell in found:
                    cells.add(cell.pop("key"), **cell)
                sys.stdout.write(f"{task.name}: {len(found)} new cells, {time.monotonic() - start:.0f} s\n")
                sys.stdout.flush()


def main() -> None:
    """Print tables over worlds and, as the last line, one JSON object."""
    chosen = arguments()
    try:
        look(chosen.part, " ".join(["ope.py", *sys.argv[1:]]), chosen.release)
    except LookError as error:
        sys.exit(str(error))
    sys.stdout.write(f"{said()}\n")
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-ope-"))
    out.mkdir(parents=True, exist_ok=True)
    cells = Cells(out / f"cells-{chosen.part}{'-quick' if chosen.quick else ''}.jsonl")
    planned = tasks(chosen, cells)
    run(planned, cells, chosen.processes, chosen.minutes)
    measured = [t.name for t in planned if cells.get(f"{t.name}/truth") is not None]
    summary = report(measured, cells, chosen.headline, out / "ope.svg", sys.stdout.write)
    result = {"name": "ope", "figures": figures(summary, chosen.headline), "ratios": {}, "baseline": "true returns"}
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    run_benchmark(main)
