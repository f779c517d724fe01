"""Where the posterior's order of candidates is lost: in the step returns, in r_end, or in the days of the data.

    python -m benchmarks.development.posterior_parts --quick              two worlds of part A
    python -m benchmarks.development.posterior_parts --worlds 24 --out FOLDER

Of each world and design it replaces one part of the estimate by what is true: the return of the steps, or r_end on new days. `true
sessions` gives the fitted outcome model the true sessions of every candidate on the days of the data, so that nothing but the model of
r_end errs. `days alone` knows all of the days of the data. Errors are of differences between candidates, shares of the range. CPU seconds
of one thread; finished worlds are kept in FOLDER.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from benchmarks.support.cells import Cells
from benchmarks.support.ope_cases import DESIGNS, STEPS, Case, virtual_case
from benchmarks.support.worlds_figure import draw_worlds
from ml.ope.compare.metrics import spearman
from ml.ope.outcomes.minutes import Minutes, by_minute, of_buffer
from ml.ope.outcomes.model import EndModel
from ml.ope.posterior.estimator import build
from ml.ope.scale import outcome_table
from ml.population.virtual import WORLDS_PER_PART, World, world
from ml.population.virtual.world import VISITS, visit_plan
from ml.trajectories import ReplayBuffer

TRUE_SESSIONS = (1 << 41) + 5000
"""First session number of the true sessions on the data's days."""
REPEATS = 4
QUICK_WORLDS, TRUTH, QUICK_TRUTH = 2, 300, 80
Floats = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


def parts(index: int, truth_sessions: int) -> dict[str, dict[str, list[float]]]:
    """Rank correlation, error and regret by design and by what is replaced."""
    case, w = virtual_case("A", index, truth_sessions), world("A", index)
    steps, ends = (_true(case, "policies", part) for part in ("step_return", "end_reward"))
    there = _true(case, "on_days", "step_return") + _true(case, "on_days", "end_reward")
    result = {}
    for design in DESIGNS:
        buffer = case.data(design)
        fitted = build("posterior", 0, "demo").fit(buffer)
        estimates = fitted.evaluate(case.candidates, STEPS)
        said = [estimates[n] for n in case.candidates]
        by_steps = np.array([e.step_return for e in said])
        by_end = np.array([e.end_reward or 0.0 for e in said])
        modelled = _of_true_sessions(w, case, buffer, fitted.ends, design)
        rows = {
            "estimate": by_steps + by_end,
            "true r_end": by_steps + ends,
            "true steps": steps + by_end,
            "true sessions": steps + modelled,
            "days alone": there,
        }
        result[design] = {name: _scores(row, steps + ends) for name, row in rows.items()}
    return result


def _true(case: Case, days: str, part: str) -> Floats:
    return np.array([case.truth[days][n][part][0] for n in case.candidates])


def _of_true_sessions(w: World, case: Case, buffer: ReplayBuffer, model: EndModel, design: str) -> Floats:
    """r_end [P] that the outcome model gives true sessions of every candidate on the days of the data, as the replays carry it."""
    days = w.data_days(visit_plan(w.settings, design, 0, VISITS), 0)  # type: ignore[arg-type]
    logged, table = of_buffer(buffer), outcome_table(buffer)
    seen = model.predict(Minutes(logged.features[None], logged.share[None], logged.late[None]), model.sessions)
    found = []
    for policy in case.candidates.values():
        runs = [w.run(policy, days, TRUE_SESSIONS + 100 * k) for k in range(REPEATS)]
        each = [model.predict(by_minute(r.beta[None], r.amplitude[None], w.settings), model.sessions) for r in runs]
        found.append(np.mean([model.carried(one, table, seen)[..., 0] for one in each]))
    return np.array(found)


def _scores(said: Floats, truth: Floats) -> list[float]:
    error, spread = said - truth, float(np.ptp(truth))
    regret = float(truth.max() - truth[int(np.argmax(said))]) / spread
    return [spearman(truth, said) or 0.0, float(np.abs(error - error.mean()).mean()) / spread, regret]


def table(rows: Mapping[str, Mapping[str, list[list[float]]]]) -> list[str]:
    """Means over worlds by design and by what is replaced."""
    lines = [f"{'':44} {'rank':>13} {'worst decile':>13} {'error':>7} {'regret':>7}\n"]
    for design, of in rows.items():
        for name, each in of.items():
            x = np.array(each)
            error = float(x[:, 0].std(ddof=1) / np.sqrt(len(x))) if len(x) > 1 else float("nan")
            mean = f"{x[:, 0].mean():.2f} ± {error:.2f}"
            lines.append(
                f"{design + ', ' + name:44} {mean:>13} {np.quantile(x[:, 0], 0.1):13.2f} {x[:, 1].mean():7.2f} {x[:, 2].mean():7.2f}\n"
            )
    return lines


def main() -> None:
    """Print the table, draw every world, and print one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_WORLDS} worlds, few simulated sessions")
    parser.add_argument("--worlds", type=int, default=WORLDS_PER_PART)
    parser.add_argument("--out", type=Path, help="folder of finished worlds and of parts.svg; a temporary one by default")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-parts-"))
    out.mkdir(parents=True, exist_ok=True)
    cells = Cells(out / f"parts{'-quick' if chosen.quick else ''}.jsonl")
    for index in range(min(chosen.worlds, QUICK_WORLDS) if chosen.quick else chosen.worlds):
        if cells.get(f"A{index:02d}") is None:
            start = time.process_time()
            found = parts(index, QUICK_TRUTH if chosen.quick else TRUTH)
            cells.add(f"A{index:02d}", parts=found, seconds=time.process_time() - start)
    done = cells.all("A")
    rows = {design: {name: [c["parts"][design][name] for c in done] for name in done[0]["parts"][design]} for design in DESIGNS}
    sys.stdout.writelines([f"{len(done)} worlds of part A\n", *table(rows)])
    drawn = {f"{design}: {name}": [x[0] for x in each] for design, of in rows.items() for name, each in of.items()}
    (out / "parts.svg").write_text(draw_worlds(drawn, f"Rank correlation, {len(done)} worlds of part A"))
    figures = {
        f"{design}_{name}".replace(" ", "_"): float(np.mean([x[0] for x in each]))
        for design, of in rows.items()
        for name, each in of.items()
    }
    sys.stdout.write(json.dumps({"name": "posterior_parts", "figures": figures, "ratios": {}, "baseline": "days alone"}) + "\n")


if __name__ == "__main__":
    main()
