"""What structures of the posterior get wrong, fitted to part A of the virtual population: the constants of `ml.ope.posterior.constants`.

    python -m benchmarks.development.model_errors --quick
    python -m benchmarks.development.model_errors --out FOLDER          the 60 worlds of part A with both designs; resumable
    python -m benchmarks.development.model_errors --part B              the present constants on part B, where none was fitted

The posterior's draws are made without any model error, and held against true differences of candidates to cDBS. Then the two constants of
each component are those of the least mean interval score (Gneiting and Raftery 2007) of these differences, a normal's 90 % interval of the
draws' variance and the error's. Part A alone is ever read. Prints the score without an error, with the present constants, and the least,
with its constants; nothing is written. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from benchmarks.support.cells import Cells
from benchmarks.support.looks import look, said
from benchmarks.support.ope_cases import CDBS, DESIGNS, STEPS, Case, virtual_case
from benchmarks.support.ope_scores import interval_score
from ml.ope.posterior.constants import MODEL_ERRORS, ModelError, error_unit
from ml.ope.posterior.estimator import Posterior, PosteriorConfig
from ml.ope.posterior.gaussian import similarity
from ml.population.virtual import WORLDS_PER_PART
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

TRUE_NAME = {"steps": "step_return"}
"""What a component is called among true means, where that differs."""
TRUTH, QUICK_TRUTH, QUICK_WORLDS = 150, 40, 2
HALF_WIDTH = 1.6449
"""Of a normal's central 90 % interval, in standard deviations."""
STARTS = ((0.01, 0.01), (0.1, 0.1), (0.3, 0.3))

ERROR, VARIANCE, OWN, CDBS_LEVERAGE, ALIKE, OWN_UNIT, CDBS_UNIT = range(7)
"""Columns of a row: error of a difference, variance of it in the draws and of the truth, leverages, correlation, units of either error."""


def rows_of(case: Case, buffer: ReplayBuffer) -> dict[str, list[list[float]]]:
    """Rows of every candidate by component."""
    policies = {**case.candidates, CDBS: case.probes[CDBS]}
    fitted = Posterior(PosteriorConfig(draws=32, model_errors={})).fit(buffer)
    _, supports, draws = fitted.joint(policies, STEPS)
    alike = similarity(list(policies.values()), buffer.transitions().states)
    s = buffer.settings
    reach = float(np.sum(s.gamma ** np.arange(STEPS))) * abs(s.r_a - s.r_b)
    found: dict[str, list[list[float]]] = {}
    for component in MODEL_ERRORS:
        if component not in draws.values:
            continue
        values, named = draws.values[component], TRUE_NAME.get(component, component)
        units = error_unit(component, values.mean(1), reach)
        cdbs_mean, cdbs_error = case.truth["policies"][CDBS][named]
        for i, name in enumerate(case.candidates):
            mean, error = case.truth["policies"][name][named]
            gap = values[i] - values[-1]
            variance = float(gap.var()) + error**2 + cdbs_error**2
            row = [float(gap.mean()) - mean + cdbs_mean, variance, supports[i].leverage, supports[-1].leverage, float(alike[i, -1])]
            found.setdefault(component, []).append([*row, float(units[i]), float(units[-1])])
    return found


def score(rows: Floats, error: ModelError) -> tuple[float, float]:
    """Mean interval score of the differences, and the share that intervals hold."""
    own, cdbs = (
        np.array([error.sd(v) for v in rows[:, leverage]]) * rows[:, unit]
        for leverage, unit in ((OWN, OWN_UNIT), (CDBS_LEVERAGE, CDBS_UNIT))
    )
    sd = np.sqrt(rows[:, VARIANCE] + own**2 + cdbs**2 - 2 * rows[:, ALIKE] * own * cdbs)
    half = HALF_WIDTH * sd
    return float(interval_score(-half, half, rows[:, ERROR]).mean()), float(np.mean(np.abs(rows[:, ERROR]) <= half))


def least(rows: Floats) -> ModelError:
    """The constants of the least score."""
    found = [minimize(lambda p: score(rows, ModelError(abs(p[0]), abs(p[1])))[0], start, method="Nelder-Mead") for start in STARTS]
    best = min(found, key=lambda f: float(f.fun)).x
    return ModelError(abs(float(best[0])), abs(float(best[1])))


def main() -> None:
    """Print scores and constants by component and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_WORLDS} worlds, few simulated sessions")
    parser.add_argument("--part", default="A", choices=("A", "B"), help="A to fit on, B to report on")
    parser.add_argument("--every", type=int, default=1, help="take every so manyth world")
    parser.add_argument("--out", type=Path, help="folder of finished worlds; a temporary one by default")
    chosen = parser.parse_args()
    look(chosen.part, " ".join(["model_errors", *sys.argv[1:]]))
    sys.stdout.write(f"{said()}\n")
    torch.set_num_threads(1)
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-model-errors-"))
    out.mkdir(parents=True, exist_ok=True)
    cells = Cells(out / f"model-errors{'-quick' if chosen.quick else ''}.jsonl")
    for index in range(0, WORLDS_PER_PART, chosen.every)[: QUICK_WORLDS if chosen.quick else None]:
        name = f"{chosen.part}{index:02d}"
        if cells.get(name) is None:
            start = time.process_time()
            case = virtual_case(chosen.part, index, QUICK_TRUTH if chosen.quick else TRUTH)
            rows = {} if case.truth["flat"] else {design: rows_of(case, case.data(design)) for design in DESIGNS}
            cells.add(name, rows=rows, seconds=time.process_time() - start)
    figures = {}
    for component, present in MODEL_ERRORS.items():
        rows = np.array([row for c in cells.all(chosen.part) for of in c["rows"].values() for row in of.get(component, [])])
        scored = {"none": ModelError(0.0, 0.0), "present": present} | ({"least": least(rows)} if chosen.part == "A" else {})
        for label, error in scored.items():
            value, held = score(rows, error)
            figures[f"{component}_{label}"] = value
            constants = f"base {error.base:.4f}, reach {error.reach:.4f}"
            sys.stdout.write(f"{component:15} {label:8} score {value:8.3f}, holds {held:.3f} of {len(rows)}; {constants}\n")
    result = {"name": "model_errors", "figures": figures, "ratios": {}, "baseline": "no model error"}
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
