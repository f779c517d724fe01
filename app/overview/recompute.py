"""Recomputation of this data package's primary tables from its sessions and steps, with numpy and scipy alone, and comparison.

    python recompute.py            in the folder of the package

Writes recomputed.csv next to the tables. Ends with 0 where every number agrees with primary.csv and noninferiority.csv, with 1 where one
does not. The docstrings describe the methods; nothing of the software that made the package is used.
"""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import rankdata, t

Row = dict[str, str]
KNOWN_SHARE = 0.5
UNBALANCED = 0.5
ENERGY_RESOLUTION = 0.05
TOLERANCE = 1e-6


def read(folder: Path, name: str) -> list[Row]:
    """Read the rows of a table."""
    with (folder / name).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def number(text: str) -> float:
    """Parse a cell; NaN where it is empty."""
    return float(text) if text else math.nan


class Outcome(NamedTuple):
    """One row of outcomes.csv; `failure` is the value of a stopped session, NaN where no session says what the worst is."""

    column: str
    higher_is_better: bool
    resolution: float
    bounded: bool
    ordinal: bool
    failure: float


def outcomes_of(folder: Path) -> dict[str, Outcome]:
    """Read the outcomes by name. A failure without a stated value counts as the worst of all sessions that are not excluded."""
    found = {}
    for row in read(folder, "outcomes.csv"):
        better, failure = row["higher_is_better"] == "true", number(row["failure"])
        if math.isnan(failure):
            measured = [number(s[row["column"]]) for s in read(folder, "sessions.csv") if not s["excluded_reason"]]
            failure = (min if better else max)((v for v in measured if math.isfinite(v)), default=math.nan)
        found[row["outcome"]] = Outcome(
            row["column"], better, float(row["resolution"]), row["bounded"] == "true", row["ordinal"] == "true", failure
        )
    return found


def metrics(folder: Path, outcomes: Mapping[str, Outcome]) -> list[dict[str, Any]]:
    """Compute the metrics of every session that counts: energy is the mean of a^2, both it and beta from at least half of the steps."""
    steps: dict[str, list[Row]] = {}
    for row in read(folder, "steps.csv"):
        if float(row["t_s"]) > 0:
            steps.setdefault(row["session_id"], []).append(row)
    found = []
    for s in read(folder, "sessions.csv"):
        if s["excluded_reason"] or s["problem"]:
            continue
        mine = steps.get(s["session_id"], [])
        a = np.array([number(r["amplitude_fraction"]) for r in mine])
        beta = np.array([number(r["beta"]) for r in mine])
        values: dict[str, float] = {name: number(s[o.column]) for name, o in outcomes.items()}
        values["energy"] = float(np.nanmean(a**2)) if known(a) else math.nan
        values["mean_beta"] = float(np.nanmean(beta)) if known(beta) and s["beta_compared"] == "true" else math.nan
        session: dict[str, Any] = dict(s)
        found.append(session | values | {"visit": int(s["visit"]), "order": float(s["ordinal"])})
    return found


def known(values: np.ndarray[Any, Any]) -> bool:
    """Check whether at least half of the values are known."""
    return bool(values.size) and float(np.mean(np.isfinite(values))) >= KNOWN_SHARE


class Contrasts:
    """Sessions of one controller and of cDBS at the visits that have both with a value."""

    def __init__(self, value: Sequence[float], visit: Sequence[int], tested: Sequence[bool], order: Sequence[float]) -> None:
        self.value, self.order = np.asarray(value, dtype=float), np.asarray(order, dtype=float)
        self.arms = []
        for v in sorted(set(visit)):
            rows = [i for i in range(len(visit)) if visit[i] == v and math.isfinite(self.value[i])]
            one, two = [i for i in rows if tested[i]], [i for i in rows if not tested[i]]
            if one and two:
                self.arms.append((np.array(one), np.array(two)))

    def means(self, value: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Compute the mean of the controller less that of cDBS, by visit."""
        return np.array([value[one].mean() - value[two].mean() for one, two in self.arms])

    def imbalance(self) -> float:
        """Compute how much later the controller comes, in standard deviations of the place, on average over visits."""
        found = []
        for one, two in self.arms:
            sd = self.order[np.r_[one, two]].std()
            found.append((self.order[one].mean() - self.order[two].mean()) / sd if sd > 0 else 0.0)
        return float(np.mean(found)) if found else 0.0

    def wins(self, value: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Compute the controller's share of won pairs, by visit; pairs less than one step of the scale apart count in proportion."""
        pairs = [np.clip(np.subtract.outer(value[one], value[two]), -1, 1) for one, two in self.arms]
        return np.array([0.5 + 0.5 * p.mean() for p in pairs])

    def half_pairs(self) -> float:
        """Average the squared half of one pair, the resolution of a visit's share of pairs: a correction for continuity."""
        return float(np.mean([(0.5 / (one.size * two.size)) ** 2 for one, two in self.arms]))

    def slope(self, visits: Iterable[int]) -> float:
        """Estimate the common slope of the value on the place within arms of visits; NaN where it cannot be estimated."""
        xx = xy = 0.0
        for k in visits:
            for arm in self.arms[k]:
                x, y = self.order[arm] - self.order[arm].mean(), self.value[arm] - self.value[arm].mean()
                xx, xy = xx + x @ x, xy + x @ y
        return xy / xx if xx > 0 else math.nan

    def floor(self, resolution: float) -> float:
        """Compute the least variance of a contrast of rounded values (Sheppard)."""
        return float(np.mean([resolution**2 / 12 * (1 / one.size + 1 / two.size) for one, two in self.arms]))


class Average(NamedTuple):
    """Average over visits, its standard error, the number of visits, and the skewness of their contrasts.

    For a metric with a floor or a ceiling, p is the larger of two. They are of Student's ratio, and of the same freed from skewness (Hall
    1992). The interval covers both. For others the skewness is 0.
    """

    estimate: float
    error: float
    visits: int
    skewness: float

    def ratios(self, value: float) -> tuple[float, float]:
        """Compute Student's ratio against a value, and the same freed from skewness."""
        n, g, ratio = self.visits, self.skewness, (self.estimate - value) / self.error
        u = ratio / math.sqrt(n)
        return ratio, ratio + math.sqrt(n) * (g * u**2 / 3 + g**2 * u**3 / 27 + g / (6 * n))

    def p_above(self, value: float) -> float:
        """Compute the one-sided p of an average of `value` or less."""
        return float(t.sf(min(self.ratios(value)), self.visits - 1))

    def p_value(self) -> float:
        """Compute the two-sided p of no difference."""
        return 2 * float(t.sf(min(abs(r) for r in self.ratios(0.0)), self.visits - 1))

    def interval(self) -> tuple[float, float]:
        """Compute the interval of 95 %."""
        n, g, q = self.visits, self.skewness, float(t.ppf(0.975, self.visits - 1))
        ends = [-q, q]
        if abs(g) >= 1e-6:
            ends += [float(3 / g * (np.cbrt(1 + g * (end / math.sqrt(n) - g / (6 * n))) - 1)) * math.sqrt(n) for end in (-q, q)]
        return self.estimate - max(ends) * self.error, self.estimate - min(ends) * self.error


def average(c: Contrasts, resolution: float, adjust: bool, bounded: bool, ordinal: bool = False) -> Average | None:
    """Average over visits; freed from a linear drift where `adjust`.

    The drift's slope is common to all visits, so that its error is that of leaving out one visit at a time. `ordinal`: of shares of pairs.
    """
    n = len(c.arms)
    if n < 2:
        return None
    contrast = c.wins if ordinal else c.means
    plain = contrast(c.value)
    floor = c.half_pairs() if ordinal else c.floor(resolution)
    if adjust:
        slopes = [c.slope(range(n))] + [c.slope(k for k in range(n) if k != out) for out in range(n)]
        if not np.isfinite(slopes).all():
            return None
        freed = [contrast(c.value - slope * c.order) for slope in slopes]
        estimate, used = float(np.mean(freed[0])), freed[0]
        without = [float(np.mean(np.delete(freed[1 + k], k))) for k in range(n)]
        variance = (n - 1) / n * float(np.sum((np.array(without) - np.mean(without)) ** 2))
        variance = variance + floor / n if ordinal else max(variance, floor / n)
    else:
        spread, used = float(plain.var(ddof=1)), plain
        estimate, variance = float(plain.mean()), (spread + floor if ordinal else max(spread, floor)) / n
    if math.sqrt(variance) <= 1e-12 * max(1.0, float(np.abs(plain).max())):
        return None
    skewness = float(np.mean((used - used.mean()) ** 3)) / (n * variance) ** 1.5 if n > 2 and bounded else 0.0
    return Average(estimate, math.sqrt(variance), n, skewness)


def primary(c: Contrasts, resolution: float, bounded: bool, ordinal: bool = False) -> Average | None:
    """Compute the average, freed from the order where one arm comes later than the other by more than half a standard deviation."""
    if abs(c.imbalance()) > UNBALANCED:
        adjusted = average(c, resolution, True, bounded, ordinal)
        if adjusted is not None:
            return adjusted
    return average(c, resolution, False, bounded, ordinal)


def rank_sum_p(x: np.ndarray[Any, Any], y: np.ndarray[Any, Any]) -> float:
    """Compute the two-sided exact rank-sum p, given the ties: twice the smaller tail. Every choice of ranks for x is equally likely."""
    ranks = np.rint(2 * rankdata(np.r_[x, y])).astype(int)
    ways = np.zeros((x.size + 1, int(ranks.sum()) + 1))
    ways[0, 0] = 1.0
    for rank in ranks:
        ways[1:, rank:] += ways[:-1, : ways.shape[1] - rank].copy()
    chance = ways[x.size] / ways[x.size].sum()
    seen = int(ranks[: x.size].sum())
    return float(min(1.0, 2 * min(chance[: seen + 1].sum(), chance[seen:].sum())))


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p-values by Holm's method."""
    order, adjusted, top = np.argsort(p_values, kind="stable"), [0.0] * len(p_values), 0.0
    for place, i in enumerate(order):
        top = max(top, min(1.0, p_values[i] * (len(p_values) - place)))
        adjusted[i] = top
    return adjusted


def primary_table(
    sessions: Sequence[dict[str, Any]], controllers: Sequence[str], outcomes: Mapping[str, Outcome]
) -> dict[tuple[str, str], dict[str, float]]:
    """Compute the primary result and the paper's test, by controller and metric."""
    found: dict[tuple[str, str], dict[str, float]] = {}
    for controller in controllers:
        taken = [s for s in sessions if s["controller"] in (controller, "cdbs")]
        for metric in ("energy", "mean_beta", *outcomes):
            tested = [s["controller"] == controller for s in taken]
            c = Contrasts([s[metric] for s in taken], [s["visit"] for s in taken], tested, [s["order"] for s in taken])
            row: dict[str, float] = {}
            of = outcomes.get(metric)
            result = primary(c, of.resolution if of else ENERGY_RESOLUTION * (metric == "energy"), of is not None and of.bounded)
            if result is not None:
                low, high = result.interval()
                row = {"estimate": result.estimate, "low": low, "high": high, "p": result.p_value()}
            x = np.array([s[metric] for s in taken if s["controller"] == controller])
            y = np.array([s[metric] for s in taken if s["controller"] == "cdbs"])
            x, y = x[np.isfinite(x)], y[np.isfinite(y)]
            if x.size and y.size and x.size * y.size <= 2500:
                row["paper_p"] = rank_sum_p(x, y)
            found[(controller, metric)] = row
    planned = [k for k in found if k[0] in ("rl", "distilled") and "p" in found[k]]
    for key, p in zip(planned, holm([found[k]["p"] for k in planned]), strict=True):
        found[key]["p_adjusted"] = p
    return found


def noninferiority(sessions: Sequence[dict[str, Any]], row: Row, outcome: Outcome) -> dict[str, float]:
    """Test one outcome of one verdict: the one-sided p of a loss of the margin or more. A stopped session counts as the worst.

    Where the margin is a share of cDBS, the cDBS values are made worse by that share and better by the margin. Ordinal values of the
    controller are made better by the margin. They must then win at least half of the pairs with the same visit's cDBS.
    """
    visits, controller = {int(v) for v in row["visits"].split()}, row["controller"]
    taken = [s for s in sessions if s["visit"] in visits and s["controller"] in (controller, "cdbs")]
    margin, sign = float(row["margin"]), 1.0 if outcome.higher_is_better else -1.0
    tested = np.array([s["controller"] == controller for s in taken])
    value = np.array([s[row["outcome"]] for s in taken])
    if row["margin_share"]:
        value = np.where(tested, value, (1 - sign * float(row["margin_share"])) * value + sign * margin)
    value = sign * value
    failed = tested & np.array([bool(s["stopped_reason"]) for s in taken])
    if outcome.ordinal:
        value = np.where(tested, value + margin, value)
    value = np.where(failed, sign * outcome.failure, value)
    c = Contrasts(value.tolist(), [s["visit"] for s in taken], tested.tolist(), [s["order"] for s in taken])
    if len(c.arms) < 3:
        return {}
    candidates = [primary(c, outcome.resolution, False, outcome.ordinal)]
    if failed.any():
        candidates.append(average(c, outcome.resolution, False, False, outcome.ordinal))  # a drift must not explain a failure away
    loss = 0.5 if outcome.ordinal else -margin
    found = [(one.estimate, one.p_above(loss)) for one in filter(None, candidates)]
    if not found:
        return {}
    estimate, p = max(found, key=lambda pair: pair[1])
    return {"estimate": estimate, "p_non_inferior": p}


def differs(stored: str, computed: float | None) -> bool:
    """Check whether a stored cell and a computed number disagree."""
    if not stored or computed is None:
        return bool(stored) and computed is None
    return abs(float(stored) - computed) > TOLERANCE * max(1.0, abs(computed))


def main(folder: Path) -> int:
    """Compute, write, compare."""
    outcomes = outcomes_of(folder)
    sessions = metrics(folder, outcomes)
    stored = [r for r in read(folder, "primary.csv") if not r["policy_id"]]
    table = primary_table(sessions, list(dict.fromkeys(r["controller"] for r in stored)), outcomes)
    wrong = []
    with (folder / "recomputed.csv").open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        names = ("estimate", "low", "high", "p", "p_adjusted", "paper_p")
        out.writerow(["controller", "metric", *names])
        for r in stored:
            mine = table[(r["controller"], r["metric"])]
            out.writerow([r["controller"], r["metric"], *(mine.get(n, "") for n in names)])
            exact = "paper_p" in mine  # with very many sessions the stored p is an approximation
            checked = [n for n in names if (n != "p_adjusted" or r["role"] == "planned") and (n != "paper_p" or exact)]
            wrong += [
                f"{r['controller']} {r['metric']} {n}: {r[n]} stored, {mine.get(n)} here" for n in checked if differs(r[n], mine.get(n))
            ]
    count = len(stored)
    for r in read(folder, "noninferiority.csv"):
        count += 1
        again = noninferiority(sessions, r, outcomes[r["outcome"]])
        named = f"{r['controller']} {r['outcome']} (margins_version {r['margins_version']}, confirmatory {r['confirmatory']})"
        wrong += [f"{named} {n}: {r[n]} stored, {again.get(n)} here" for n in ("estimate", "p_non_inferior") if differs(r[n], again.get(n))]
    said = "\n".join(wrong) if wrong else f"{count} rows of primary.csv and noninferiority.csv recomputed: all agree."
    sys.stdout.write(f"{said}\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(Path(__file__).resolve().parent))
