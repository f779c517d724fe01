"""What a calibration says of predictions, in sentences that name no method: how far off, in which order, what going by them cost."""

from __future__ import annotations

import numpy as np

from app.analysis.calibration.schemas import AccuracyOut, CalibrationOut, PredictionOut
from app.platform.web.charts import counted

CHANCE = 0.05
"""Permutation p-value below which an order is called better than chance."""

FEW_PAIRS = 8
"""Pairs of a policy and a visit below which the sentences say that they are few."""


def in_sentences(found: CalibrationOut, method: str) -> list[str]:
    """The method's record over all visits; empty where nothing of it could be compared.

    Args:
        found: the calibration. method: one of its methods.
    """
    overall = next((m for m in found.metrics if m.method == method and m.visit is None), None)
    if overall is None:
        return []
    pairs = [q for p in found.policies if p.reference is None for q in p.predictions if q.method == method]
    visits = len({p.visit for p in found.policies if p.reference is None})
    return [
        _distance(overall, pairs, visits),
        _order(overall),
        *_choice(overall),
        _honesty(overall, found.level),
        *_few(overall),
    ]


def _distance(m: AccuracyOut, pairs: list[PredictionOut], visits: int) -> str:
    shift = float(np.mean([q.predicted - q.actual for q in pairs]))
    side = f"on average {abs(shift):.1f} too {'high' if shift > 0 else 'low'}"
    share = f" ({100 * m.mae_of_range.value:.0f} % of the range of what was seen)" if m.mae_of_range.value is not None else ""
    error = f"{m.mae.value:.1f}" if m.mae.value is not None else "an unknown amount"
    return (
        f"What a session is worth was predicted {error} off in the mean{share}, over {counted(m.policies, 'test')} of a policy at "
        f"{counted(visits, 'visit')}, {side}."
    )


def _order(m: AccuracyOut) -> str:
    rank = m.rank_correlation
    if rank.value is None:
        return f"Whether policies were put in the right order cannot be said: {rank.missing}."
    p = "" if m.rank_p is None else f", p = {m.rank_p:.2f}" if m.rank_p >= 0.01 else ", p < 0.01"
    if m.rank_p is not None and m.rank_p < CHANCE:
        verdict = "Policies were put in the right order better than by chance" if rank.value > 0 else "Policies were put in the wrong order"
    else:
        verdict = "The order of policies cannot be told from chance"
    return f"{verdict} (rank correlation {rank.value:.2f}{p})."


def _choice(m: AccuracyOut) -> list[str]:
    if m.regret.value is None:
        return [f"What going by it cost cannot be said: {m.regret.missing}."]
    if m.regret.value <= 0:
        return ["At every visit the policy put first was worth the most."]
    share = f", {100 * m.regret_of_range.value:.0f} % of the visit's range" if m.regret_of_range.value is not None else ""
    return [f"The policy put first was worth {m.regret.value:.1f} less than the best of its visit{share}, averaged over the visits."]


def _honesty(m: AccuracyOut, level: float) -> str:
    held = round((m.coverage.value or 0.0) * m.policies)
    return f"The {100 * level:.0f} % intervals held the truth in {held} of {counted(m.policies, 'test')}."


def _few(m: AccuracyOut) -> list[str]:
    if m.policies >= FEW_PAIRS:
        return []
    return [f"{counted(m.policies, 'test of a policy is', 'tests of a policy are')} few: much of this may be chance."]
