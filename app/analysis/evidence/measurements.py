"""Facts of sessions as the statistics want them: one metric of a controller (or a policy) and of cDBS. No database."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.analysis.evidence.facts import BetaKind, Facts, Missing
from app.tables.sessions import Controller
from ml.outcomes import OUTCOMES
from ml.statistics.within_visits.contrasts import Measurements

HIGHER_IS_BETTER = {"energy": False, "mean_beta": False} | {o.key: o.higher_is_better for o in OUTCOMES}
RESOLUTION = {"energy": 0.05} | {o.key: o.resolution for o in OUTCOMES}
"""Step between neighbouring values of a metric; 0 where it is continuous. Stimulators deliver steps of 0.1 mA: at cDBS of 4 mA, 0.05 of its
energy. Without it, a controller of one constant amplitude would save the same at every visit, and no test could say so; nor could one say
of a participant who never trembles that none came, if shares of the time were taken for more exact than to 1 %."""

BOUNDED = frozenset(o.key for o in OUTCOMES if o.bounded)
"""Metrics that end at a floor or a ceiling which sessions reach."""


@dataclass(frozen=True)
class Chosen:
    """The sessions of a comparison, aligned with its measurements, n of them.

    Attributes:
        data: values of one metric. sessions: the facts, [n]. stopped: stopped for the patient's sake, [n].
        policy: numbers, 0 for none, [n].
    """

    data: Measurements
    sessions: tuple[Facts, ...]
    stopped: NDArray[np.bool_]
    policy: NDArray[np.int64]


def choose(sessions: Sequence[Facts], metric: str, is_tested: Callable[[Facts], bool]) -> Chosen:
    """One metric of the sessions that `is_tested` names and of all cDBS sessions."""
    return choose_each(sessions, (metric,), is_tested)[metric]


def choose_each(sessions: Sequence[Facts], metrics: Sequence[str], is_tested: Callable[[Facts], bool]) -> dict[str, Chosen]:
    """Several metrics of the same sessions."""
    taken = tuple(s for s in sessions if s.controller is Controller.CDBS or is_tested(s))
    nothing = float("nan")
    plain = Measurements.of(
        np.full(len(taken), nothing),
        [s.visit for s in taken],
        [s.controller is not Controller.CDBS for s in taken],
        order=[float(s.ordinal) for s in taken],
        medication_h=[nothing if s.medication_h is None else s.medication_h for s in taken],
    )
    stopped = np.array([s.stopped is not None for s in taken], dtype=np.bool_)
    policy = np.array([s.arm.policy_id or 0 for s in taken], dtype=np.int64)
    found = {}
    for metric in metrics:
        value = np.array([s.values.get(metric, nothing) for s in taken], dtype=np.float64)
        data = replace(plain, value=value, resolution=RESOLUTION.get(metric, 0.0), bounded=metric in BOUNDED)
        found[metric] = Chosen(data, taken, stopped, policy)
    return found


def of_controller(controller: Controller) -> Callable[[Facts], bool]:
    """Sessions of a controller, whichever policy ran."""
    return lambda s: s.controller is controller


def comparable_beta(sessions: Sequence[Facts], unit: str | None, source: str | None) -> BetaKind | None:
    """The kind of beta that is compared: the participant's where some session has it, else the most frequent."""
    kinds = Counter(s.beta_kind for s in sessions if s.beta_kind and "mean_beta" in s.values)
    wanted = BetaKind(unit or "", source or "")
    if wanted in kinds or not kinds:
        return wanted if kinds else None
    return kinds.most_common(1)[0][0]


def with_comparable_beta(sessions: Sequence[Facts], kind: BetaKind | None) -> tuple[Facts, ...]:
    """The sessions, those with another kind of beta without their mean beta."""
    return tuple(
        s
        if "mean_beta" not in s.values or s.beta_kind == kind
        else replace(
            s,
            values={k: v for k, v in s.values.items() if k != "mean_beta"},
            missing={**s.missing, "mean_beta": Missing.OTHER_BETA},
        )
        for s in sessions
    )
