"""Dose shapes of outcomes pooled in cohorts of virtual patients: when the proof holds, and what the posterior gains where it does.

Three kinds of cohorts, of part A alone: *unrelated*, worlds of part A by chance, of different mechanisms and traits; *family*, patients of
one world's mechanism and trait with constants of their own; *one shape*, the same patients whose symptoms have the world's own dose
response. Each patient in turn is the participant, and the others of its cohort are those that are asked, as the service does it. *Proved*
pools an outcome where the proof holds, *always* whatever it says. Differences are paired with the posterior without
pooling, over patients with an r_end whose candidates differ by more than two standard errors, taken as independent.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from ml.ope.compare.metrics import spearman
from ml.ope.estimate import Estimate
from ml.ope.outcomes.pooling import Pooled, Proof, pool, prove, shape_prior
from ml.ope.outcomes.regressions import ORDER
from ml.ope.posterior.estimator import build
from ml.policies.policy import ConstantPolicy
from ml.population.virtual import WORLDS_PER_PART, World, world

from .cells import Cells
from .observer import patient_alike
from .ope_cases import CDBS, DESIGNS, STEPS
from .ope_scores import interval_score

KINDS = ("unrelated", "family", "one shape")
COHORTS, PATIENTS = 6, 8
QUICK_PATIENTS = 5
TRUTH, QUICK_TRUTH = 100, 30
MEASURES = ("rank", "regret", "error", "r_end", "score", "width", "holds")
"""Spearman's rank correlation; of the range: regret, error of differences between candidates, root mean squared error of r_end against cDBS
(points), mean interval score, median width; share of the truths that 90 % intervals hold."""

Evidence = dict[str, list[float]]


def with_end() -> list[int]:
    """Worlds of part A that have an r_end."""
    return [i for i in range(WORLDS_PER_PART) if world("A", i).settings.c2 > 0]


def cohort(kind: str, number: int, patients: int) -> list[World]:
    """The patients of a cohort."""
    if kind == "unrelated":
        order = np.random.default_rng(0x500D).permutation(WORLDS_PER_PART)
        return [world("A", int(i)) for i in order[number * patients : (number + 1) * patients]]
    there = with_end()
    w = world("A", there[number * len(there) // COHORTS])
    alike = [patient_alike(w, k) for k in range(patients)]
    return alike if kind == "family" else [_of_shape(p, w) for p in alike]


def _of_shape(w: World, like: World) -> World:
    p = like.patient
    return replace(w, patient=w.patient._replace(sym_shape=p.sym_shape, sym_half=p.sym_half, sym_steep=p.sym_steep))


def measured(kind: str, number: int, patients: int, truth: int, design: str) -> dict[str, Any]:
    """What a cohort's evidences say, and `MEASURES` of each patient without pooling, proved, and always."""
    members, fits, evidences, rows = cohort(kind, number, patients), [], [], []
    for w in members:
        fits.append(build("posterior", 0, "demo").fit(w.data(design)))  # type: ignore[arg-type]
        evidences.append({o: v.tolist() for o, v in fits[-1].ends.shape_evidence.items()})
    for i, (w, fitted) in enumerate(zip(members, fits, strict=True)):
        policies = {**w.candidates(), CDBS: ConstantPolicy(1.0)}
        true = {n: w.truth(p, truth).to_json() for n, p in policies.items()}
        others = [e for j, e in enumerate(evidences) if j != i]
        proved, always = pool(evidences[i], others), _always(others)
        alone = fitted.evaluate(policies, STEPS)
        ways = {"alone": alone}
        for name, pooled in (("proved", proved), ("always", always)):
            ways[name] = fitted.with_pooled(pooled).evaluate(policies, STEPS) if pooled.priors else alone
        own = fitted.with_pooled(always).shape_pooling
        rows.append(
            {
                "used": {o: o in proved.priors for o in own},
                "own_gain": {o: found["own_gain"] for o, found in own.items() if "own_gain" in found},
                "counts": w.settings.c2 > 0 and not _flat(true),
                "ways": {name: scores(estimates, true) for name, estimates in ways.items()},
            }
        )
    return {"evidence": evidences, "patients": rows}


def _always(others: Sequence[Evidence]) -> Pooled:
    """Priors from the others whatever the proofs say."""
    known = {o: np.array([e[o] for e in others if o in e]) for o in ORDER}
    return Pooled({o: Proof(np.zeros(0)) for o in ORDER}, {o: shape_prior(v) for o, v in known.items() if len(v)})


def _flat(true: Mapping[str, Any]) -> bool:
    totals = [t["total"] for n, t in true.items() if n != CDBS]
    return bool(np.ptp([v for v, _ in totals]) < 2 * np.mean([e for _, e in totals]))


def scores(estimates: Mapping[str, Estimate], true: Mapping[str, Any]) -> list[float]:
    """`MEASURES` of one patient."""
    names = [n for n in estimates if n != CDBS]
    said, low, high = (np.array([getattr(estimates[n], part) for n in names]) for part in ("value", "low", "high"))
    truth = np.array([true[n]["total"][0] for n in names])
    ends = np.array([(estimates[n].end_reward or 0.0) - true[n]["end_reward"][0] for n in (*names, CDBS)])
    spread, miss = float(np.ptp(truth)), said - truth
    return [
        spearman(truth, said) or 0.0,
        float(truth.max() - truth[int(np.argmax(said))]) / spread,
        float(np.abs(miss - miss.mean()).mean()) / spread,
        float(np.sqrt(np.mean((ends[:-1] - ends[-1]) ** 2))),
        float(interval_score(low, high, truth).mean()) / spread,
        float(np.median(high - low)) / spread,
        float(np.mean((low <= truth) & (truth <= high))),
    ]


def proofs(found: Sequence[dict[str, Any]]) -> dict[str, list[float]]:
    """By outcome: cohorts, those whose proof holds, mean gain and its standard error over cohorts; patients, those of them who are pooled,
    and what their own data gain then."""
    result = {}
    for outcome in ORDER:
        each = [prove(np.array([e[outcome] for e in f["evidence"] if outcome in e])) for f in found]
        gains = np.array([p.mean or 0.0 for p in each])
        rows = [r for f in found for r in f["patients"] if outcome in r["own_gain"]]
        used = [r["own_gain"][outcome] for r in rows if r["used"][outcome]]
        result[outcome] = [len(each), sum(p.holds for p in each), float(gains.mean()), _error(gains), len(rows), len(used),
                           float(np.mean(used)) if used else float("nan"), _error(np.array(used))]  # fmt: skip
    return result


def _error(values: np.ndarray) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def lines(found: Sequence[dict[str, Any]]) -> list[str]:
    """The proofs of a kind and design, and what the posterior gains."""
    result = []
    for outcome, (n, held, mean, error, rows, used, own, own_error) in proofs(found).items():
        result.append(
            f"  {outcome:8} proof holds in {held:.0f} of {n:.0f} cohorts, gain {mean:+.2f} ± {error:.2f} nats; used for {used:.0f} of "
            f"{rows:.0f} patients, whose own data gain {own:+.2f} ± {own_error:.2f}\n"
        )
    counted = [r["ways"] for f in found for r in f["patients"] if r["counts"]]
    if not counted:
        return result
    alone = np.array([w["alone"] for w in counted])
    result.append(f"  {f'{len(counted)} patients':16}" + "".join(f"{m:>18}" for m in MEASURES) + "\n")
    result.append(f"  {'alone':16}" + "".join(f"{f'{alone[:, j].mean():.3f}':>18}" for j in range(len(MEASURES))) + "\n")
    for way in ("proved", "always"):
        change = np.array([w[way] for w in counted]) - alone
        cells = [f"{change[:, j].mean():+.3f} ± {_error(change[:, j]):.3f}" for j in range(len(MEASURES))]
        result.append(f"  {way:16}" + "".join(f"{cell:>18}" for cell in cells) + "\n")
    return result


def figures(found: Mapping[tuple[str, str], Sequence[dict[str, Any]]]) -> dict[str, float]:
    """The numbers of the last line."""
    result = {}
    for (kind, design), each in found.items():
        name = f"{kind}_{design}".replace(" ", "_")
        for outcome, row in proofs(each).items():
            result |= {f"{name}_{outcome}_held": row[1] / row[0], f"{name}_{outcome}_gain": row[2]}
        counted = [r["ways"] for f in each for r in f["patients"] if r["counts"]]
        for j in [MEASURES.index(m) for m in ("rank", "score")] if counted else []:
            result[f"{name}_{MEASURES[j]}_change"] = float(np.mean([w["proved"][j] - w["alone"][j] for w in counted]))
    return result


def cohorts_pooled(cells: Cells, cohorts: int, quick: bool) -> dict[str, float]:
    """Measure the cohorts that are not there yet, print proofs and differences by kind and design, and give the numbers.

    Args:
        cells: of finished cohorts. cohorts: of each kind, at most `COHORTS`. quick: one small cohort of each kind, one design.
    """
    designs = DESIGNS[:1] if quick else DESIGNS
    patients, truth = (QUICK_PATIENTS, QUICK_TRUTH) if quick else (PATIENTS, TRUTH)
    for number, kind, design in product(range(1 if quick else min(cohorts, COHORTS)), KINDS, designs):
        key = f"{kind}/{design}/{number}"
        if cells.get(key) is None:
            start = time.process_time()
            found = measured(kind, number, patients, truth, design)
            cells.add(key, found=found, seconds=time.process_time() - start)
            sys.stdout.write(f"{key}: {time.process_time() - start:.0f} CPU s\n")
            sys.stdout.flush()
    done = {(kind, design): [c["found"] for c in cells.all(f"{kind}/{design}/")] for kind in KINDS for design in designs}
    for (kind, design), each in done.items():
        sys.stdout.writelines([f"{kind}, {design}: {len(each)} cohorts\n", *lines(each)])
    return figures(done)
