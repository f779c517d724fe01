"""Learn the constants of the posterior over policies (`ml/ope/posterior/learned/constants.npz`) from worlds whose truth is known.

    python benchmarks/posterior_constants.py --quick                   a few worlds, to see that it works; constants of no use
    python benchmarks/posterior_constants.py --out FOLDER              simulate, learn, and say what was gained; resumable
    python benchmarks/posterior_constants.py --out FOLDER --write      the same, and replace the constants of the project

The worlds have the distribution of the virtual population and are in none of its parts, so that part A measures what was learned as well as
part B does. What is printed is cross-validated over worlds; sizes of errors come from the same left-out worlds.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from support.ope_scores import interval_score
from support.training import Example, Training, folds, plain, train
from support.training_worlds import QOCS, Cell, simulated

from ml.ope.compare.metrics import spearman
from ml.ope.observed import mean_over_days
from ml.ope.posterior.constants import VERSION
from ml.ope.posterior.draws import KEPT
from ml.ope.posterior.learned.evidence import STRUCTURES
from ml.ope.posterior.learned.networks import FILE

Floats = NDArray[np.float64]

OUTCOMES_MISSING = 0.1
"""Share of examples whose outcomes are taken away: not every record has them."""
FOLDS = 5
WORLDS, QUICK_WORLDS = 253, 6
FACTORS = (0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4, 1.6)
"""On sizes of errors, from which one is chosen."""
NETWORKS = Training(members=8, epochs=60, decay=3e-2)
LEFT_OUT_MEMBERS = 4
"""Networks of each fold of the cross-validation, for time."""
SEEN = (
    *("price", "dose", "late dose", "switching", "moving", "leverage", "effect", "effect sd", "apart", "burden", "burden gained"),
    *(f"{structure} {what}" for structure in STRUCTURES for what in ("effect", "weight")),
    *("skill", "skill z", "miss", "near effect", "near effect sd", "log visits", "random switching"),
    *(f"{name}{what}" for name in QOCS for what in ("", " sd", " skill")),
)
"""What the networks see. With further numbers of the record (arms, noise, slopes within sessions) 250 worlds gave no better order, and
networks on the record alone misjudged systems of which these worlds have none (`tests/ml/ope/posterior/known_system.py`)."""


def examples_of(cells: Sequence[Cell]) -> list[Example]:
    """Examples for the networks."""
    rng = np.random.default_rng(2)
    found = [Example({n: c.evidence.parts[n] for n in SEEN}, c.evidence.expected, c.truth, c.returns, c.world) for c in cells]
    return [without_outcomes(e) if rng.random() < OUTCOMES_MISSING else e for e in found]


def without_outcomes(example: Example) -> Example:
    """The same record where nobody measured the outcomes."""
    parts = {name: np.zeros_like(v) if any(q in name for q in QOCS) else v for name, v in example.parts.items()}
    keep = np.array([1.0, 0.0, 0.0, 0.0])
    return Example(parts, example.base * keep, example.truth * keep, example.returns * keep, example.world)


@dataclass(frozen=True)
class LeftOut:
    """What is said of worlds that were not learned from.

    Attributes:
        means, sds: of differences, [P, 4] each. level: errors of levels under cDBS, [4]. over_days: their standard deviations over
            days, [4].
    """

    means: list[Floats]
    sds: list[Floats]
    level: list[Floats]
    over_days: list[Floats]


def left_out(cells: Sequence[Cell], examples: Sequence[Example]) -> LeftOut:
    """Every world by networks that have not learned from it."""
    means, sds = [np.zeros(0)] * len(examples), [np.zeros(0)] * len(examples)
    for fold in folds(examples, FOLDS):
        held = set(fold.tolist())
        found = train([e for k, e in enumerate(examples) if k not in held], replace(NETWORKS, members=LEFT_OUT_MEMBERS))
        for k in held:
            means[k], sds[k] = found.of(examples[k].parts, examples[k].base)
    level, over_days = [], []
    for c in cells:
        days = [mean_over_days(c.cdbs[None, :, q], c.visits, KEPT, 0) for q in range(4)]
        level.append(np.array([c.level[q] - c.cdbs[:, q] @ d.weights for q, d in enumerate(days)]))
        over_days.append(np.array([d.common.std() for d in days]))
    return LeftOut(means, sds, level, over_days)


def said(examples: Sequence[Example], means: Sequence[Floats]) -> None:
    """Print how well differences order the candidates, before and after."""
    rows = []
    for e, mean in zip(examples, means, strict=True):
        truth, *others = (v[:-1] @ e.returns for v in (e.truth, e.base, mean))
        rows.append([*(spearman(truth, v) or 0.0 for v in others), *(np.abs(v - truth).mean() / np.ptp(truth) for v in others)])
    m = np.array(rows).mean(0)
    sys.stdout.write(f"{len(rows)} records: rank correlation {m[0]:.3f} -> {m[1]:.3f}, error of differences {m[2]:.2f} -> {m[3]:.2f}\n")


def sizes(examples: Sequence[Example], found: LeftOut) -> dict[str, Floats]:
    """Sizes of errors and what they have in common, by left-out worlds: the fields of `Learned`.

    The shape of a level's error is that of the largest likelihood. Then one factor on the errors of differences and one on those of levels
    are chosen by the interval score of 90 % intervals of returns, of differences and of the whole.
    """
    z = np.concatenate([((e.truth - m) / np.maximum(s, 1e-9))[:-1] for e, m, s in zip(examples, found.means, found.sds, strict=True)])
    together = np.corrcoef(np.clip(z, -3, 3).T)
    errors, over_days = np.array(found.level), np.array(found.over_days)
    shapes = [_level_shape(errors[:, q], over_days[:, q]) for q in range(4)]
    common, own = np.array(shapes).T
    level_z = np.clip(errors / np.hypot(common * over_days, own), -3, 3)
    shared = np.array(
        [np.clip((e.truth - m)[:-1] / s[:-1], -3, 3).mean(0) for e, m, s in zip(examples, found.means, found.sds, strict=True)]
    )
    against = np.array([np.corrcoef(level_z[:, q], shared[:, q])[0, 1] for q in range(4)])
    wider = min(FACTORS, key=lambda f: np.mean([_score(e, found, k, together, f, None) for k, e in enumerate(examples)]))
    level = (common, own, against)
    factor = min(FACTORS, key=lambda f: np.mean([_score(e, found, k, together, wider, (f, level)) for k, e in enumerate(examples)]))
    return {
        "wider": np.full(4, wider),
        "together": together,
        "level_common": factor * common,
        "level_own": factor * own,
        "level_against": against,
    }


def _score(e: Example, found: LeftOut, k: int, together: Floats, wider: float, level: tuple[float, Any] | None) -> float:
    """Interval score over the range of true differences: of differences, or with a level of the whole returns."""
    truth, said = (e.truth[:-1] @ e.returns), (found.means[k][:-1] @ e.returns)
    spread = wider * found.sds[k][:-1] * e.returns
    variance, error = np.einsum("pq,qr,pr->p", spread, together, spread), truth - said
    if level is not None:
        factor, (common, own, against) = level
        size = factor * np.hypot(common * found.over_days[k], own) * np.abs(e.returns)
        variance = variance + (size**2).sum() + 2 * (np.abs(spread) * (against * size)).sum(1)
        error = error + found.level[k] @ e.returns
    sd = np.sqrt(np.maximum(variance, 1e-12))
    return float(interval_score(said - 1.645 * sd, said + 1.645 * sd, said + error).mean() / np.ptp(truth))


def _level_shape(error: Floats, over_days: Floats) -> tuple[float, float]:
    """Standard deviation of an error as a share of that over days, and besides, of the largest likelihood (Student's t, four degrees)."""
    limit, best = float(np.median(np.abs(error))), (np.inf, 0.0, 0.0)
    for share in np.linspace(0.0, 1.0, 11):
        for own in limit * np.linspace(0.1, 2.0, 20):
            size = np.hypot(share * over_days, own)
            best = min(best, (float(np.mean(2.5 * np.log1p((error / size) ** 2 / 4) + np.log(size))), float(share), float(own)))
    return best[1], best[2]


def main() -> None:
    """Simulate, learn, report; with --write replace the project's constants."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder of what is simulated; a temporary one by default")
    parser.add_argument("--worlds", type=int, default=WORLDS, help="worlds to learn from")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_WORLDS} worlds; writes nothing into the project")
    parser.add_argument("--write", action="store_true", help="replace ml/ope/posterior/learned/constants.npz")
    chosen = parser.parse_args()
    if chosen.quick and chosen.write:
        parser.error("constants that are learned from a few worlds do not replace the project's: leave --quick or --write away")
    torch.set_num_threads(1)
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-constants-"))
    cells = simulated(QUICK_WORLDS if chosen.quick else chosen.worlds, out)
    examples = examples_of(cells)
    found = left_out(cells, examples)
    said(examples, found.means)
    arrays: dict[str, Any] = {"version": np.int64(VERSION), **sizes(examples, found)}
    sys.stdout.write("".join(f"{name}: {np.round(value, 3).tolist()}\n" for name, value in arrays.items()))
    target = FILE if chosen.write else out / FILE.name
    np.savez_compressed(target, **arrays, **plain(train(examples, NETWORKS)))
    sys.stdout.write(f"{target}: {target.stat().st_size / 1e3:.0f} kB\n")


if __name__ == "__main__":
    main()
