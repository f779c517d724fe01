"""Cases of the evaluation benchmarks: a virtual patient with its data, its policies and their true returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ml.policies.policy import ConstantPolicy, Policy
from ml.population.virtual import Truth, is_responder, simple_policies, world
from ml.population.virtual.world import VISITS, visit_plan
from ml.trajectories import ReplayBuffer

CDBS, MATCHED = "cDBS", "matched constant"
DESIGNS = ("stratified", "paper")


@dataclass(frozen=True)
class Case:
    """One patient to evaluate on.

    Attributes:
        name: its name. candidates: what is ranked. probes: besides, cDBS, and a constant at the mean amplitude of `follows`.
        low, follows: candidates that represent a lower sustained dose, and for following beta. truth: JSON-able, see `virtual_case`.
        data: design -> buffer.
    """

    name: str
    candidates: Mapping[str, Policy]
    probes: Mapping[str, Policy]
    low: str
    follows: str
    truth: dict[str, Any]
    data: Callable[[str], ReplayBuffer]


def virtual_case(part: str, index: int, sessions: int, known: dict[str, Any] | None = None) -> Case:
    """Make the case of a world of the virtual population.

    Args:
        part, index: which. sessions: simulated ones behind each true return. known: truth from an earlier run.

    Returns:
        Its case. `truth` has `policies` and `on_days` (name -> means with standard errors), `dose` and `follow` (true difference of returns
        with its standard error, same days and noise), `responder`, `mechanism`, `silent`, `flat` (range below two standard errors) and
        `sessions` of the data.
    """
    w = world(part, index)  # type: ignore[arg-type]
    candidates, low, follows = w.candidates(), "constant low", "proportional slow"
    truth, probes = known, {CDBS: ConstantPolicy(1.0)}
    if truth is None:
        truths = {n: w.truth(p, sessions) for n, p in (candidates | probes).items()}
        truths[MATCHED] = w.truth(ConstantPolicy(truths[follows].amplitude.value), sessions)
        simple = {n: w.truth(p, sessions) for n, p in simple_policies(w.settings, w.spread).items()}
        v = np.array([truths[n].total.value for n in candidates])
        error = float(np.mean([truths[n].total.standard_error for n in candidates]))
        truth = {
            "policies": {n: t.to_json() for n, t in truths.items()},
            "on_days": {n: w.truth_on_data_days(p, sessions).to_json() for n, p in candidates.items()},
            "dose": _difference(truths[low], truths[CDBS]),
            "follow": _difference(truths[follows], truths[MATCHED]),
            "responder": is_responder(simple, truths[CDBS]),
            "mechanism": w.patient.mechanism,
            "silent": not w.patient.beta_answers,
            "flat": bool(np.ptp(v) < 2 * error),
            "sessions": len(visit_plan(w.settings, "paper", 0, VISITS)),
        }
    matched = ConstantPolicy(truth["policies"][MATCHED]["amplitude"][0])
    return Case(f"{part}{index:02d}", candidates, {**probes, MATCHED: matched}, low, follows, truth, lambda d: w.data(d))  # type: ignore[arg-type]


def _difference(first: Truth, second: Truth) -> list[float]:
    gap = first.returns - second.returns
    return [float(gap.mean()), float(gap.std(ddof=1) / np.sqrt(gap.size))]
