"""Worth of verdicts: how many candidates get one, how often `test` is right, and when an order is refused for want of skill.

    python -m benchmarks.evaluation.verdicts --quick
    python -m benchmarks.evaluation.verdicts --out FOLDER                   the 60 worlds of part A; resumable
    python -m benchmarks.evaluation.verdicts --part B --out FOLDER          to report on; each run is counted

Verdicts are those of the service's defaults after three visits. A candidate is truly worth a test where all three QoCs are within the
margins of cDBS and it saves energy. *Nothing answers*: the same sessions with beta and QoCs as under cDBS throughout, whatever amplitude
the log says. An order of policies by them is an order of noise. True returns only measure. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.support.cells import Cells
from benchmarks.support.looks import look, said
from benchmarks.support.ope_cases import CDBS, DESIGNS, Case, virtual_case
from benchmarks.support.results import run_benchmark
from ml.ope.compare.metrics import spearman
from ml.ope.posterior.estimator import build
from ml.ope.posterior.verdict import Levels, verdict
from ml.outcomes import PREDICTED
from ml.population.virtual import WORLDS_PER_PART, DataDesign, World, world
from ml.population.virtual.world import MARGINS, STEPS, VISITS, visit_plan
from ml.qoc import Margins
from ml.trajectories import ReplayBuffer

TRUTH, QUICK_TRUTH, QUICK_WORLDS = 150, 40, 2
UNANSWERED = 1 << 42
"""First session number of sessions in which nothing answers."""


def without_answer(w: World, design: DataDesign) -> ReplayBuffer:
    """Make the data of a world whose beta and QoCs are those of cDBS, whatever the logged amplitude."""
    buffer, rows = w.data(design), visit_plan(w.settings, design, 0, VISITS)
    days, sessions = w.data_days(rows, 0), []
    for i, (session, row) in enumerate(zip(buffer.sessions, rows, strict=True)):
        own, cdbs = days.select(slice(i, i + 1)), np.ones((1, row.amplitudes.size))
        run = w.run(cdbs, own, UNANSWERED + i, row.amplitudes.size)
        sessions.append(replace(session, beta=run.beta[0], lead_beta=run.lead[0], qoc=run.qoc(0)))
    return replace(buffer, sessions=tuple(sessions))


def worth_a_test(case: Case, name: str) -> bool:
    """Decide whether a candidate is truly within the margins and saves energy."""
    own, cdbs = case.truth["policies"][name], case.truth["policies"][CDBS]
    return bool(
        all(o.slack(own[o.field][0], cdbs[o.field][0], MARGINS.of(o)) >= 0 for o, _ in PREDICTED) and own["energy"][0] < cdbs["energy"][0]
    )


def measured(case: Case, w: World, design: DataDesign) -> dict[str, Any]:
    """Compare the verdicts of one data set with the truth, its order, and whether an order is given where nothing answers."""
    estimates = build("posterior", 0, "demo").fit(case.data(design)).evaluate({**case.candidates, CDBS: case.probes[CDBS]}, STEPS)
    found = {n: verdict(estimates[n], estimates[CDBS], Margins(), Levels()) for n in case.candidates}
    true = [case.truth["policies"][n]["total"][0] for n in case.candidates]
    nothing = build("posterior", 0, "demo").fit(without_answer(w, design)).evaluate(dict(list(case.candidates.items())[:1]), STEPS)
    return {
        "verdicts": [[v.code, worth_a_test(case, n), v.within] for n, v in found.items()],
        "told": bool(estimates[CDBS].details["skill"]["told"]),
        "rank": spearman(np.array(true), np.array([estimates[n].value for n in case.candidates])) or 0.0,
        "told_without_answer": bool(next(iter(nothing.values())).details["skill"]["told"]),
    }


def summary(cells: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Compute shares over the worlds of one design."""
    rows = [(code, right) for c in cells for code, right, _ in c["verdicts"]]
    codes, worth = Counter(code for code, _ in rows), sum(right for _, right in rows)
    right = Counter(code for code, ok in rows if ok)

    def mean(values: Sequence[float]) -> float:
        return float(np.mean(values)) if values else float("nan")

    return {
        "worlds": float(len(cells)),
        **{f"share_{code}": codes[code] / len(rows) for code in ("test", "test_with_care", "same_as_cdbs", "unsafe", "cannot_tell")},
        "precision_of_test": right["test"] / codes["test"] if codes["test"] else float("nan"),
        "recall_of_test": right["test"] / worth if worth else float("nan"),
        "worth_though_unsafe": right["unsafe"] / codes["unsafe"] if codes["unsafe"] else float("nan"),
        "order_told": mean([c["told"] for c in cells]),
        "order_told_where_nothing_answers": mean([c["told_without_answer"] for c in cells]),
        "rank_where_told": mean([c["rank"] for c in cells if c["told"]]),
        "rank_where_not": mean([c["rank"] for c in cells if not c["told"]]),
    }


def reliability(cells: Sequence[dict[str, Any]]) -> list[str]:
    """Tabulate how often outcomes and energy are truly as wanted, by the probability that all outcomes are within their margins."""
    rows = np.array([(within, right) for c in cells for _, right, within in c["verdicts"] if within is not None], dtype=np.float64)
    lines = []
    for low, high in ((0.0, 0.1), (0.1, 0.25), (0.25, 0.5), (0.5, 0.65), (0.65, 0.8), (0.8, 0.9), (0.9, 1.001)):
        of = rows[(rows[:, 0] >= low) & (rows[:, 0] < high), 1]
        lines.append(
            f"  within with {low:.2f} to {min(high, 1.0):.2f}: {of.size:4} candidates, truly worth a test {of.mean():.2f}\n"
            if of.size
            else ""
        )
    return lines


def main() -> None:
    """Print the shares by design and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_WORLDS} worlds, few simulated sessions")
    parser.add_argument("--part", default="A", choices=("A", "B"), help="A to develop on, B to report on")
    parser.add_argument("--worlds", type=int, default=WORLDS_PER_PART)
    parser.add_argument("--first", type=int, default=0, help="index of the first world")
    parser.add_argument("--every", type=int, default=1, help="take every so manyth world")
    parser.add_argument("--out", type=Path, help="folder of finished worlds; a temporary one by default")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    look(chosen.part, " ".join(["verdicts", *sys.argv[1:]]), None)
    sys.stdout.write(f"{said()}\n")
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-verdicts-"))
    out.mkdir(parents=True, exist_ok=True)
    cells = Cells(out / f"verdicts{'-quick' if chosen.quick else ''}.jsonl")
    for index in range(chosen.first, WORLDS_PER_PART, chosen.every)[: QUICK_WORLDS if chosen.quick else chosen.worlds]:
        if cells.get(f"{chosen.part}{index:02d}") is not None:
            continue
        start = time.process_time()
        case = virtual_case(chosen.part, index, QUICK_TRUTH if chosen.quick else TRUTH)
        found = {} if case.truth["flat"] else {d: measured(case, world(chosen.part, index), d) for d in DESIGNS}
        cells.add(f"{chosen.part}{index:02d}", designs=found, seconds=time.process_time() - start)
    figures: dict[str, float] = {}
    for design, suffix in zip(DESIGNS, ("", "_paper"), strict=True):
        rows = [c["designs"][design] for c in cells.all(chosen.part) if c["designs"]]
        found = summary(rows)
        sys.stdout.writelines([f"{design}\n", *(f"  {k}: {v:.3g}\n" for k, v in found.items()), *reliability(rows)])
        figures |= {k + suffix: v for k, v in found.items() if np.isfinite(v)}
    figures["cpu_seconds_per_world"] = float(np.mean([c["seconds"] for c in cells.all(chosen.part)]))
    sys.stdout.write(json.dumps({"name": "verdicts", "figures": figures, "ratios": {}, "baseline": "what is true"}) + "\n")


if __name__ == "__main__":
    run_benchmark(main)
