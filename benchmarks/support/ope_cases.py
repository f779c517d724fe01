"""What the evaluation benchmark measures on: a world or a participant with its data, its policies and what is true of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ml.policies.policy import ConstantPolicy, Policy
from ml.population.virtual import Truth, is_responder, simple_policies, world
from ml.population.virtual.world import STEPS, VISITS, visit_plan
from ml.trajectories import ReplayBuffer

from .ope_policies import fixed_policies
from .simulators import WORLDS as SIMULATORS

CDBS, MATCHED = "cDBS", "matched constant"
DESIGNS = ("stratified", "paper")
PARTICIPANT_VISITS = 3


@dataclass(frozen=True)
class Case:
    """One patient to evaluate on.

    Attributes:
        name: its name. candidates: what is ranked. probes: besides, cDBS, and a constant at the mean amplitude of `follows`.
        low, follows: candidates that stand for a lower sustained dose, and for following beta. truth: JSON-able, see `virtual_case`.
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
    """A world of the virtual population.

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


def participant_case(code: str, sessions: int, known: dict[str, Any] | None = None) -> Case:
    """A detailed participant with data by the paper's design; the keys of `truth` as above, without a responder."""
    simulator = SIMULATORS[code]()
    candidates = fixed_policies(simulator.settings.xi_beta)
    probes = {CDBS: ConstantPolicy(1.0), MATCHED: ConstantPolicy(0.6)}
    truth = known
    if truth is None:
        found = {n: simulator.truth(p, sessions) for n, p in (candidates | probes).items()}
        there = {n: simulator.truth_on_days(p, 0, PARTICIPANT_VISITS, sessions // 2) for n, p in candidates.items()}
        flat = float(np.ptp([found[n].total for n in candidates])) < 2 * float(np.mean([t.standard_error for t in found.values()]))

        def pair(first: str, second: str) -> list[float]:
            error = float(np.hypot(found[first].standard_error, found[second].standard_error))
            return [found[first].total - found[second].total, error]

        truth = {
            "policies": {
                n: {"total": [t.total, t.standard_error], "returns_sd": t.standard_error * np.sqrt(sessions)} for n, t in found.items()
            },
            "on_days": {n: {"total": [t.total, t.standard_error]} for n, t in there.items() if t is not None},
            "dose": pair("constant 0.40", CDBS),
            "follow": pair("proportional fast", MATCHED),
            "responder": True,
            "mechanism": "participant",
            "silent": False,
            "flat": flat,
            "sessions": len(simulator.data(0, PARTICIPANT_VISITS).sessions),
        }
    return Case(code, candidates, probes, "constant 0.40", "proportional fast", truth, lambda _: simulator.data(0, PARTICIPANT_VISITS))


def _difference(first: Truth, second: Truth) -> list[float]:
    gap = first.returns - second.returns
    return [float(gap.mean()), float(gap.std(ddof=1) / np.sqrt(gap.size))]


__all__ = ["CDBS", "DESIGNS", "MATCHED", "STEPS", "Case", "participant_case", "virtual_case"]
