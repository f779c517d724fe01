"""Forms of the DLSM on worlds of part A: the paper's, that of before its features, the present one, and features taken away one by one.

    python -m benchmarks.development.dlsm_forms --quick                      one world, one design, short fits
    python -m benchmarks.development.dlsm_forms --out FOLDER --designs stratified [--forms "as before|dlsm"] [--every 6] [--worlds 10]

`as before` is the default of before: no linear part, a Gaussian density on the reward. `all kept` is `dlsm` with no
member discarded; the forms after it each lack or have one feature more. Keys of methods are forms too.

Every form is fitted at the size of a first look with the same seed. Rank correlation, regret, mean absolute error and median width of the
90 % intervals over a world's candidates; the last three are shares of the range of true returns. Below the means stand paired differences
to the first form with their standard errors over data sets. Finished cells are lines of FOLDER/forms.jsonl; a run that is started again
skips them. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.support.cells import Cells
from benchmarks.support.ope_cases import STEPS, Case, virtual_case
from ml.ope.compare.metrics import spearman
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.estimator import Dlsm
from ml.ope.estimate import Estimator
from ml.ope.registry import build
from ml.population.virtual import WORLDS_PER_PART

BEFORE, EXPERT = DlsmConfig.demo(), DlsmConfig.expert("demo")
ALONE = replace(EXPERT, discard=False)
FORMS: dict[str, DlsmConfig] = {
    "as before": BEFORE,
    "residual": replace(BEFORE, residual=True, reward_terms=False, learning_rate=EXPERT.learning_rate),
    "all kept": ALONE,
    "pretrained": replace(EXPERT, pretrained=True),
    "no overshooting": replace(ALONE, overshoot=0),
    "no free bits": replace(ALONE, free_bits=0.0),
    "no resampling": replace(ALONE, bootstrap=False),
    "no contrast": replace(ALONE, dose_contrast=False),
    "recurrent heads": replace(ALONE, recurrent_heads=True),
}
USUAL = ("as before", "linear", "residual", "all kept", "pretrained", "dlsm_paper")
TRUTH, QUICK_TRUTH = 120, 40
PARTS = ("rank", "regret", "mae", "width", "inside", "seconds")


def estimator(form: str) -> Estimator:
    """The DLSM of a form, or another method by its key."""
    return Dlsm(FORMS[form]) if form in FORMS else build(form, 0, "demo")


def measure(case: Case, design: str, form: str) -> dict[str, Any]:
    """One form on one data set."""
    buffer, start = case.data(design), time.process_time()
    try:
        found = estimator(form).fit(buffer).evaluate(case.candidates, STEPS)
    except ValueError as error:
        return {"failed": str(error), "seconds": time.process_time() - start}
    seconds = time.process_time() - start
    truth = np.array([case.truth["policies"][n]["total"][0] for n in case.candidates])
    said = [found[n] for n in case.candidates]
    values = np.array([e.value for e in said])
    spread = float(np.ptp(truth))
    return {
        "rank": spearman(truth, values) or 0.0,
        "regret": float(truth.max() - truth[int(np.argmax(values))]) / spread,
        "mae": float(np.abs(values - truth).mean()) / spread,
        "width": float(np.median([e.high - e.low for e in said])) / spread,
        "inside": float(np.mean([e.low <= t <= e.high for e, t in zip(said, truth, strict=True)])),
        "seconds": seconds,
        "values": [round(float(v), 3) for v in values],
        "held_out": said[0].details.get("held_out"),
    }


def show(forms: list[str], cells: list[dict[str, Any]]) -> dict[str, float]:
    """Means over data sets that every form has, and paired differences to the first form."""
    tables = [{c["form"]: c for c in cells if c["data"] == data and "rank" in c} for data in dict.fromkeys(c["data"] for c in cells)]
    whole = [t for t in tables if all(f in t for f in forms)]
    out = sys.stdout.write
    out(f"{len(whole)} of {len(tables)} data sets\n{'':28}" + "".join(f"{p:>18}" for p in PARTS) + "\n")
    figures: dict[str, float] = {}
    x = np.array([[[t[f][p] for p in PARTS] for f in forms] for t in whole]).reshape(len(whole), len(forms), len(PARTS))
    for k, form in enumerate(forms if len(whole) else []):
        out(f"{form:28}" + "".join(_mean(x[:, k, j]) for j in range(len(PARTS))) + "\n")
        figures |= {f"{form}/{p}": float(x[:, k, j].mean()) for j, p in enumerate(PARTS)}
    for k, form in enumerate(forms[1:] if len(whole) > 1 else [], 1):
        out(f"{form + ' less ' + forms[0]:28}" + "".join(_mean(x[:, k, j] - x[:, 0, j], sign="+") for j in range(len(PARTS))) + "\n")
    return figures


def _mean(values: np.ndarray[Any, Any], sign: str = "") -> str:
    error = float(values.std(ddof=1) / np.sqrt(values.size)) if values.size > 1 else float("nan")
    return f"{format(float(values.mean()), sign + '.2f') + f' ± {error:.2f}':>18}"


def main() -> None:
    """Print the table and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one world, few simulated sessions")
    parser.add_argument("--forms", default="|".join(USUAL), help="names with | between them; a key of another method is one too")
    parser.add_argument("--designs", default="stratified,paper")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--every", type=int, default=6)
    parser.add_argument("--worlds", type=int, default=WORLDS_PER_PART)
    parser.add_argument("--truth", type=int, default=TRUTH, help="simulated sessions behind each true return")
    parser.add_argument("--out", type=Path, help="folder of forms.jsonl; a temporary one by default")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    if chosen.quick:
        chosen.worlds, chosen.truth, chosen.designs = 1, QUICK_TRUTH, "stratified"
        FORMS.update({f: replace(c, steps=30, members=1, rollouts=32) for f, c in FORMS.items()})
        chosen.forms = "as before|all kept"
    forms, designs = chosen.forms.split("|"), chosen.designs.split(",")
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-dlsm-forms-"))
    out.mkdir(parents=True, exist_ok=True)
    cells = Cells(out / f"forms{'-quick' if chosen.quick else ''}.jsonl")
    indices = range(chosen.first, WORLDS_PER_PART, chosen.every)[: chosen.worlds]
    for index in indices:
        key = f"truth/{index}/{chosen.truth}"
        known = cells.get(key)
        case = virtual_case("A", index, chosen.truth, known and known["truth"])
        if known is None:
            cells.add(key, truth=case.truth)
        for design in designs:
            for form in forms:
                name = f"cell/{index}/{design}/{form}"
                if cells.get(name) is None:
                    found = cells.add(name, data=f"{index}/{design}", form=form, **measure(case, design, form))
                    parts = ", ".join(f"{p} {found[p]:.2f}" for p in PARTS if p in found)
                    sys.stdout.write(f"{name}: {parts or found['failed']}\n")
                    sys.stdout.flush()
    done = [c for i in indices for d in designs for f in forms if (c := cells.get(f"cell/{i}/{d}/{f}"))]
    sys.stdout.write(json.dumps({"name": "dlsm_forms", "figures": show(forms, done), "ratios": {}, "baseline": forms[0]}) + "\n")


if __name__ == "__main__":
    main()
