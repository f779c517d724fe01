"""Table of aims: what the answer after three visits is worth on the second virtual population, in half of which following beta pays.

    python benchmarks/answer.py --quick                      eight worlds, few simulated sessions; at most two CPU minutes
    python benchmarks/answer.py --out FOLDER                 the 60 worlds of part A; resumable
    python benchmarks/answer.py --part B --out FOLDER        to report on; each run is counted
    python benchmarks/answer.py --population 1               the first population, as a second report
    python benchmarks/answer.py --calibrate                  the monotone map of chances that part A gives (`verdict.CALIBRATION`)

A candidate is worth a test if all QoCs are truly within the margins of cDBS and it saves energy. It is safe if they are within the margins.
The page is ordered by estimated return, candidates with a hazard last. The pick is its first *test*, else cDBS. Its loss is to the best
safe policy, cDBS among them, as a share of the range of true returns. Following pays in a world if its best safe closed loop beats its
best safe constant by 5 % of that range. Errors are standard errors over worlds; those of a ratio of sums are linearised. True returns
only measure. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from support.cells import Cells
from support.looks import look, said
from support.results import emit, run_benchmark

from ml.ope.compare.gain import gain_over
from ml.ope.compare.metrics import spearman
from ml.ope.posterior.estimator import build
from ml.ope.posterior.verdict import Levels, calibrate, share_within, verdict
from ml.outcomes import PREDICTED
from ml.policies.policy import ConstantPolicy
from ml.population.virtual import WORLDS_PER_PART, Truth, world
from ml.population.virtual.world import MARGINS, STEPS, within_margins
from ml.qoc import Margins

TRUTH, QUICK_TRUTH, QUICK_WORLDS = 150, 40, 8
CDBS = "cDBS"
LEAST = 0.05
"""Share of the range that counts as a difference."""
Row = dict[str, Any]
World = list[Row]


def harmful(own: Truth, cdbs: Truth) -> bool:
    """Decide whether an outcome is truly worse than under cDBS by more than twice its margin."""
    return any(o.slack(own.qocs[o.field].value, cdbs.qocs[o.field].value, 2 * MARGINS.of(o)) < 0 for o, _ in PREDICTED)


def cell(part: str, index: int, population: int, truth: int) -> World:
    """Judge the candidates of one world after three stratified visits, cDBS last, with the truth of each."""
    w = world(part, index, population)  # type: ignore[arg-type]
    policies = {**w.candidates(), CDBS: ConstantPolicy(1.0)}
    estimates = build("posterior", 0, "demo").fit(w.data("stratified")).evaluate(policies, STEPS)
    truths = {name: w.truth(policy, truth) for name, policy in policies.items()}
    cdbs, reference = truths[CDBS], estimates[CDBS]
    found = []
    for name, own in estimates.items():
        gain, true = gain_over(own, reference), truths[name]
        result = verdict(own, reference, Margins(), Levels())
        found.append(
            {
                "name": name,
                "code": result.code,
                "hazard": bool(result.hazards),
                "share": share_within(own, reference, Margins()),
                "value": own.value,
                "gain": [gain.low, gain.high],
                "true": true.total.value,
                "constant": isinstance(policies[name], ConstantPolicy),
                "safe": within_margins(true, cdbs),
                "harm": harmful(true, cdbs),
                "worth": within_margins(true, cdbs) and true.energy.value < cdbs.energy.value,
            }
        )
    return found


def candidates(rows: World) -> World:
    """List the rows without cDBS."""
    return [r for r in rows if r["name"] != CDBS]


def width(rows: World) -> float:
    """Compute the range of the true returns of the candidates."""
    true = [r["true"] for r in candidates(rows)]
    return max(max(true) - min(true), 1e-9)


def pick(rows: World) -> Row:
    """Choose the page's first test; cDBS where there is none."""
    tests = [r for r in candidates(rows) if r["code"] == "test"]
    return max(tests, key=lambda r: r["value"]) if tests else rows[-1]


def loss(rows: World, choice: Row) -> float:
    """Compute what a choice lacks of the best safe policy, share of the range."""
    best = max(r["true"] for r in rows if r["safe"])
    return max(0.0, best - float(choice["true"])) / width(rows)


def safe_pick(rows: World) -> Row:
    """Choose the best by value among those that are truly safe: what a perfect judgement of harm would leave of the loss."""
    return max((r for r in rows if r["safe"]), key=lambda r: r["value"])


def following_pays(rows: World) -> bool:
    """Decide whether the best safe closed loop truly beats the best safe constant by a twentieth of the range."""
    loops = [r["true"] for r in candidates(rows) if r["safe"] and r["worth"] and not r["constant"]]
    constants = [r["true"] for r in rows if r["safe"] and r["constant"]]
    return bool(loops) and max(loops) - max(constants) >= LEAST * width(rows)


def ratio(top: Sequence[float], bottom: Sequence[float]) -> tuple[float, float]:
    """Compute a ratio of sums over worlds and its linearised standard error; NaN where nothing is below."""
    a, b = np.asarray(top, dtype=np.float64), np.asarray(bottom, dtype=np.float64)
    if not b.sum():
        return float("nan"), float("nan")
    value = float(a.sum() / b.sum())
    return value, float(np.sqrt(((a - value * b) ** 2).sum()) / b.sum())


def share_of(worlds: Sequence[World], question: Callable[[Row], bool], group: Callable[[Row], bool]) -> tuple[float, float]:
    """Compute the share of the candidates among some for which something holds, with its error over worlds."""
    inside = [[r for r in candidates(rows) if group(r)] for rows in worlds]
    return ratio([sum(map(question, rows)) for rows in inside], [len(rows) for rows in inside])


def order(worlds: Sequence[World], last: Callable[[Row], bool], key: str = "value") -> tuple[float, float]:
    """Compute the rank correlation with true returns of an order by a number, some candidates last; its mean over worlds."""
    found = []
    for rows in map(candidates, worlds):
        place = np.empty(len(rows))
        place[sorted(range(len(rows)), key=lambda i: (last(rows[i]), -rows[i][key]))] = np.arange(len(rows))
        found.append(spearman(np.array([r["true"] for r in rows]), -place) or 0.0)
    return ratio(found, [1.0] * len(worlds))


def aims(worlds: Sequence[World]) -> dict[str, tuple[float, float]]:
    """Measure every aim that three visits of one data set can show, with its standard error."""
    ones, pays = [1.0] * len(worlds), [rows for rows in worlds if following_pays(rows)]

    def covered(r: Row, cdbs: Row) -> bool:
        return bool(r["gain"][0] <= r["true"] - cdbs["true"] <= r["gain"][1])

    cover = [sum(covered(r, rows[-1]) for r in candidates(rows)) for rows in worlds]
    widths = [float(np.median([r["gain"][1] - r["gain"][0] for r in candidates(rows)])) / width(rows) for rows in worlds]
    return {
        "loss of the pick": ratio([loss(rows, pick(rows)) for rows in worlds], ones),
        "pick within 5 % of the best safe": ratio([loss(rows, pick(rows)) <= LEAST for rows in worlds], ones),
        "loss, were harm known": ratio([loss(rows, safe_pick(rows)) for rows in worlds], ones),
        "pick truly harmful": ratio([pick(rows)["harm"] for rows in worlds], ones),
        "test: precision": share_of(worlds, lambda r: r["worth"], lambda r: r["code"] == "test"),
        "test: recall": share_of(worlds, lambda r: r["code"] == "test", lambda r: r["worth"]),
        "recall, less what acts as cDBS": share_of(
            worlds, lambda r: r["code"] == "test", lambda r: r["worth"] and r["code"] != "same_as_cdbs"
        ),
        "unsafe that are worth a test": share_of(worlds, lambda r: r["worth"], lambda r: r["code"] == "unsafe"),
        "harmful called unsafe": share_of(worlds, lambda r: r["code"] == "unsafe", lambda r: r["harm"]),
        "harmful called test": share_of(worlds, lambda r: r["code"] == "test", lambda r: r["harm"]),
        "rank correlation by value": order(worlds, lambda r: False),
        "rank correlation of the page": order(worlds, lambda r: r["hazard"]),
        "the same, were harm known": order(worlds, lambda r: r["harm"]),
        "the same, were harm and value known": order(worlds, lambda r: r["harm"], "true"),
        "worlds where following pays": ratio([following_pays(rows) for rows in worlds], ones),
        "there, a closed loop is a test": ratio(
            [any(r["code"] == "test" and not r["constant"] for r in candidates(rows)) for rows in pays], [1.0] * len(pays)
        ),
        "there, the pick is a closed loop": ratio([not pick(rows)["constant"] for rows in pays], [1.0] * len(pays)),
        "intervals to cDBS that cover": ratio(cover, [len(candidates(rows)) for rows in worlds]),
        "their median width, share of the range": ratio(widths, ones),
    }


def reliability(worlds: Sequence[World], edges: Sequence[float] = (0.1, 0.25, 0.5, 0.65, 0.8, 0.9)) -> list[tuple[int, float, float]]:
    """Compare calibrated probabilities with truth: candidates between two edges, the mean that was stated, the share truly within."""
    known = [r for rows in worlds for r in candidates(rows) if r["share"] is not None]
    stated, true = np.array([calibrate(r["share"]) for r in known]), np.array([r["safe"] for r in known], dtype=np.float64)
    column = np.searchsorted(edges, stated, "right")
    parts = [column == k for k in range(len(edges) + 1) if (column == k).any()]
    return [(int(p.sum()), round(float(stated[p].mean()), 2), round(float(true[p].mean()), 2)) for p in parts]


AIMS = {
    "loss of the pick": "<= 0.12",
    "pick within 5 % of the best safe": ">= 0.60",
    "test: precision": ">= 0.95",
    "test: recall": ">= 0.70",
    "unsafe that are worth a test": "<= 0.05",
    "there, a closed loop is a test": ">= 0.80",
    "there, the pick is a closed loop": ">= 0.60",
    "intervals to cDBS that cover": "0.85 to 0.95",
}


def monotone(said_share: Sequence[float], true: Sequence[bool], blocks: int = 12) -> list[tuple[float, float]]:
    """Fit a monotone map from shares of draws to truths: means of blocks of equal number, pooled where they fall (isotonic regression)."""
    order = np.argsort(said_share, kind="stable")
    parts = [p for p in np.array_split(order, blocks) if p.size]
    pooled: list[tuple[float, float, int]] = []
    for p in parts:
        x, y, n = float(np.asarray(said_share)[p].mean()), float(np.asarray(true, dtype=np.float64)[p].mean()), int(p.size)
        while pooled and pooled[-1][1] >= y:
            a, b, k = pooled.pop()
            x, y, n = (a * k + x * n) / (n + k), (b * k + y * n) / (n + k), n + k
        pooled.append((x, y, n))
    return [(round(x, 2), round(y, 2)) for x, y, _ in pooled]


def main() -> None:
    """Print the aims and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_WORLDS} worlds, few simulated sessions")
    parser.add_argument("--part", default="A", choices=("A", "B"), help="A to develop on, B to report on")
    parser.add_argument("--population", type=int, default=2, choices=(1, 2))
    parser.add_argument("--worlds", type=int, default=WORLDS_PER_PART)
    parser.add_argument("--calibrate", action="store_true", help="print the monotone map of chances; of part A alone")
    parser.add_argument("--out", type=Path, help="folder of finished worlds; a temporary one by default")
    chosen = parser.parse_args()
    if chosen.calibrate and chosen.part != "A":
        parser.error("chances are calibrated on part A alone")
    torch.set_num_threads(1)
    look(chosen.part, " ".join(["answer.py", *sys.argv[1:]]), None)
    emit(f"{said()}\n")
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-answer-"))
    out.mkdir(parents=True, exist_ok=True)
    prefix = f"{chosen.part}{chosen.population}-"
    cells, number = Cells(out / f"answer{'-quick' if chosen.quick else ''}.jsonl"), QUICK_WORLDS if chosen.quick else chosen.worlds
    for index in range(number):
        key = f"{prefix}{index:02d}"
        if cells.get(key) is None:
            start = time.process_time()
            rows = cell(chosen.part, index, chosen.population, QUICK_TRUTH if chosen.quick else TRUTH)
            cells.add(key, rows=rows, seconds=time.process_time() - start)
    worlds = [c["rows"] for c in cells.all(prefix)]
    figures = aims(worlds)
    emit(f"{len(worlds)} worlds of part {chosen.part}, population {chosen.population}\n{'':<42}{'':>8}{'error':>8}  aim\n")
    for name, (value, error) in figures.items():
        emit(f"{name:<42}{value:>8.2f}{error:>8.2f}  {AIMS.get(name, '')}\n")
    emit("of candidates called so likely no worse, so many were\n")
    for number, stated, true in reliability(worlds):
        emit(f"{number:>6} candidates{100 * stated:>6.0f} %{100 * true:>6.0f} %\n")
    if chosen.calibrate:
        known = [r for rows in worlds for r in candidates(rows) if r["share"] is not None]
        emit(f"CALIBRATION = {monotone([r['share'] for r in known], [r['safe'] for r in known])}\n")
    shown = {name: round(value, 4) for name, (value, _) in figures.items() if np.isfinite(value)}
    shown["cpu_seconds_per_world"] = float(np.mean([c["seconds"] for c in cells.all(prefix)]))
    emit(json.dumps({"name": "answer", "figures": shown, "ratios": {}, "baseline": "what is true"}) + "\n")


if __name__ == "__main__":
    run_benchmark(main)
