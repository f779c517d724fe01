"""Tables, figure and headline figures of the evaluation benchmark, out of its cells."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from .figure import draw
from .ope_scores import Told, over_worlds, scores_of_tests, signs, world_scores
from .worlds_figure import draw_worlds

DESIGNS = ("stratified", "paper")
ORACLES = ("days alone", "tested")
METHODS = ("posterior", "linear", "impulse", "fqe", "wdr", "dlmm", "pdis", "wis", "cwpdis", "dual_dice", "dlsm")
METRICS = ("rank", "regret", "sharpe", "mae", "interval score", "width", "coverage", "worst first")
SHOWN = (*METRICS, "supported")
LOW_IS_WORSE = ("rank", "sharpe", "coverage", "supported")
PAIRED = ("rank", "regret", "mae", "interval score")
DRAWN = {
    "rank": "rank correlation",
    "regret": "regret, % of range",
    "sharpe": "SharpeRatio@3",
    "mae": "MAE, % of range",
    "interval score": "interval score, % of range",
    "width": "median width, % of range",
    "coverage": "intervals that hold the truth, %",
    "dose right": "sign of the answer to sustained dose, right among those told, %",
    "dose told": "sign of the answer to sustained dose, told, %",
    "follow right": "sign of the gain of following beta, right among those told, %",
    "follow told": "sign of the gain of following beta, told, %",
}
"""Metric -> title of its panel; signs are shares over worlds, all others means of one number per world."""


class Table(Protocol):
    """Cells by key."""

    def get(self, key: str) -> Any: ...


@dataclass
class Row:
    """Results of one method with one design: metrics per world, in order, and its answers about signs."""

    worlds: list[str] = field(default_factory=list)
    scores: dict[str, list[float | None]] = field(default_factory=dict)
    dose: list[Told] = field(default_factory=list)
    dose_of_responders: list[Told] = field(default_factory=list)
    follow: list[Told] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    failed: int = 0

    def add(self, name: str, scores: dict[str, float | None]) -> None:
        self.worlds.append(name)
        for metric in (*SHOWN, *(f"{m} supported" for m in METRICS)):
            self.scores.setdefault(metric, []).append(scores.get(metric))

    def summary(self, metric: str) -> dict[str, float]:
        return over_worlds(self.scores.get(metric, []), worst_is_low=metric.removesuffix(" supported") in LOW_IS_WORSE)

    def drawn(self, metric: str) -> list[float]:
        """List the numbers of one panel of the figure: one for each world, of signs the share over worlds; empty where there is none."""
        if metric in self.scores:
            return [(100 if "%" in DRAWN[metric] else 1) * x for x in self.scores[metric] if x is not None]
        answers, what = metric.split()
        right, unknown = signs(self.dose if answers == "dose" else self.follow)
        share = right if what == "right" else 1 - unknown
        return [] if math.isnan(share) else [100 * share]


Summary = dict[tuple[str, str], Row]


def summarise(names: Iterable[str], cells: Table, methods: list[str]) -> Summary:
    """Summarise what each (design, method) did. Worlds whose range of true returns is within its error are excluded."""
    result: Summary = {}
    for name in names:
        truth = cells.get(f"{name}/truth")
        if truth["flat"]:
            continue
        candidates = list(truth["on_days"])
        v = [truth["policies"][n]["total"][0] for n in candidates]
        cdbs = truth["policies"]["cDBS"]["total"][0]
        for design in DESIGNS:
            if not any(cells.get(f"{name}/{design}/{method}") for method in methods):
                continue
            for method in methods:
                cell = cells.get(f"{name}/{design}/{method}")
                if cell is not None:
                    _add(result.setdefault((design, method), Row()), name, truth, cell, candidates, v, cdbs)
            days = [{"value": x, "low": x, "high": x} for x in (truth["on_days"][n]["total"][0] for n in candidates)]
            result.setdefault((design, "days alone"), Row()).add(name, world_scores(v, days, cdbs))
            spread = [truth["policies"][n]["returns_sd"] for n in candidates]
            result.setdefault((design, "tested"), Row()).add(name, scores_of_tests(v, spread, cdbs, truth["sessions"]))
    return result


def _add(row: Row, name: str, truth: dict[str, Any], cell: dict[str, Any], candidates: list[str], v: list[float], cdbs: float) -> None:
    row.seconds.append(cell["seconds"])
    if "failed" in cell:
        row.failed += 1
        return
    row.add(name, world_scores(v, [cell["estimates"][n] for n in candidates], cdbs))
    dose = Told(*cell["dose"], *truth["dose"])
    row.dose.append(dose)
    row.follow.append(Told(*cell["follow"], *truth["follow"]))
    if truth["responder"]:
        row.dose_of_responders.append(dose)


def report(names: Iterable[str], cells: Table, headline: str, figure: Path, out: Callable[[str], Any]) -> Summary:
    """Print tables, draw the figure, and return what they were made from."""
    names = list(names)
    truths = [cells.get(f"{n}/truth") for n in names]
    summary = summarise(names, cells, list(METHODS))
    flat = [n for n, t in zip(names, truths, strict=True) if t["flat"]]
    responders, silent = (sum(t[what] for t in truths) for what in ("responder", "silent"))
    out(f"{len(names)} worlds, {responders} responders, {silent} with a beta that hardly answers\n")
    out(f"worlds left out because true returns are alike within two standard errors: {', '.join(flat) or 'none'}\n")
    for design in DESIGNS:
        _table(summary, design, headline, out)
    found = {
        design: {
            method: {title: row.drawn(metric) for metric, title in DRAWN.items()}
            for (d, method), row in summary.items()
            if d == design and row.worlds
        }
        for design in DESIGNS
    }
    figure.write_text(draw({d: t for d, t in found.items() if t}, tuple(DRAWN.values())))
    ranks = {f"{m}, {d}": [x for x in row.scores["rank"] if x is not None] for (d, m), row in summary.items() if row.worlds}
    over_worlds_figure = figure.with_name(f"{figure.stem}-worlds.svg")
    title = "rank correlation, one dot per world (long bar: mean, short bar: worst decile)"
    over_worlds_figure.write_text(draw_worlds({label: x for label, x in ranks.items() if x}, title))
    out(f"figures: {figure}, {over_worlds_figure}\n")
    return summary


def _table(summary: Summary, design: str, headline: str, out: Callable[[str], Any]) -> None:
    rows = {m: r for (d, m), r in summary.items() if d == design}
    if not rows:
        return
    for among, metrics in (("all candidates", SHOWN), ("those that the method supports", tuple(f"{m} supported" for m in METRICS))):
        out(f"\n{design} design, {among}; mean (median, worst decile) over worlds, shares of the range of true returns\n")
        out(f"{'':<11}{'worlds':>7}" + "".join(f"{m.removesuffix(' supported'):>24}" for m in metrics) + f"{'CPU s':>8}\n")
        for method, row in sorted(rows.items(), key=lambda item: -(item[1].summary("rank")["mean"] if item[1].worlds else -2)):
            texts = [_cell(row.summary(m)) for m in metrics]
            seconds = f"{np.mean(row.seconds):.1f}" if row.seconds else "-"
            failed = f"   failed in {row.failed}" if row.failed else ""
            out(f"{method:<11}{len(row.worlds):>7}" + "".join(f"{t:>24}" for t in texts) + f"{seconds:>8}{failed}\n")
    for method, row in rows.items():
        if method not in ORACLES and row.worlds:
            dose, follow = signs(row.dose), signs(row.follow)
            unknown = signs(row.dose_of_responders)[1]
            out(
                f"{method}: sustained dose, sign right {dose[0]:.2f}, not told {dose[1]:.2f} (responders {unknown:.2f}); "
                f"following beta, sign right {follow[0]:.2f}, not told {follow[1]:.2f}\n"
            )
    _paired(rows, headline, out)


def _cell(s: dict[str, float]) -> str:
    return f"{s['mean']:.2f} ({s['median']:.2f}, {s['decile']:.2f})"


def _paired(rows: dict[str, Row], headline: str, out: Callable[[str], Any]) -> None:
    """Print the differences of `PAIRED` from the headline's, on the worlds that both have, with standard errors."""
    base = rows.get(headline)
    for method, row in rows.items():
        if base is None or method == headline:
            continue
        common = [w for w in base.worlds if w in row.worlds]
        texts = []
        for metric in PAIRED:
            gaps = [_at(base, w, metric) - _at(row, w, metric) for w in common]
            s = over_worlds(gaps, worst_is_low=True)
            texts.append(f"{metric} {s['mean']:+.2f} +- {s['error']:.2f}")
        out(f"{headline} less {method}, {len(common)} worlds: {', '.join(texts)}\n")


def _at(row: Row, name: str, metric: str) -> float:
    value = row.scores[metric][row.worlds.index(name)]
    return float("nan") if value is None else value


def figures(summary: Summary, headline: str) -> dict[str, float | None]:
    """Compute the figures of the last line: of the headline's method with the stratified design, and with the paper's (`_paper`)."""
    result: dict[str, float | None] = {}
    for design, suffix in (("stratified", ""), ("paper", "_paper")):
        row = summary.get((design, headline), Row())
        named = {
            "rank_mean": row.summary("rank")["mean"],
            "rank_worst_decile": row.summary("rank")["decile"],
            "regret_mean": row.summary("regret")["mean"],
            "mae_mean": row.summary("mae")["mean"],
            "coverage": row.summary("coverage")["mean"],
            "median_width": row.summary("width")["median"],
            "interval_score": row.summary("interval score")["mean"],
            "dose_sign_right": signs(row.dose)[0],
            "dose_sign_unknown": signs(row.dose_of_responders)[1],
            "worst_first_confident": row.summary("worst first")["mean"],
        }
        result |= {"n_worlds" + suffix: float(len(row.worlds))} | {k + suffix: v for k, v in named.items()}
    return {k: None if v is None or math.isnan(v) else v for k, v in result.items()}
