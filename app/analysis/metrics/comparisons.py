"""One metric of every controller against cDBS: groups, Wilcoxon rank-sum tests, and when there is not enough data for one. No database.

Source: Gao et al. 2023, section 6.1. Ours: the check of the numbers of sessions, Holm's adjustment, the difference with its interval.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np

from app.platform.web.numbers import p_text
from app.study.blinding import CONTROLLER_NAMES
from app.tables.sessions import Controller
from ml.statistics.multiplicity import holm
from ml.statistics.ranksum import rank_sum

ALPHA = 0.05
LEVEL = 0.95
"""Coverage of the intervals of differences."""


@dataclass(frozen=True)
class Group:
    """Values of one metric under one controller.

    Attributes:
        n: sessions with a value.
        median, q1, q3: None where n is 0.
        values, session_ids: aligned, in the order of the sessions.
    """

    controller: Controller
    label: str
    n: int
    median: float | None
    q1: float | None
    q3: float | None
    values: tuple[float, ...]
    session_ids: tuple[int, ...]


@dataclass(frozen=True)
class Comparison:
    """A controller against cDBS.

    Attributes:
        p_value: two-sided, unadjusted as in the paper; None where there is not enough data.
        p_holm: the same adjusted for all comparisons of the participant.
        method: `exact` or `normal approximation`.
        difference: Hodges-Lehmann estimate of controller less cDBS, in the metric's unit.
        low, high: its interval of `level`.
        note: the check that failed; empty where the test was made.
    """

    controller: Controller
    label: str
    n_controller: int
    n_cdbs: int
    p_value: float | None = None
    p_holm: float | None = None
    method: str | None = None
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    level: float = LEVEL
    note: str = ""


def group(controller: Controller, values: Mapping[int, float]) -> Group:
    """Summarise values by session id."""
    numbers = tuple(float(v) for v in values.values())
    q1, median, q3 = (float(q) for q in np.percentile(numbers, (25, 50, 75))) if numbers else (None, None, None)
    return Group(controller, CONTROLLER_NAMES[controller], len(numbers), median, q1, q3, numbers, tuple(values))


def compare(tested: Group, cdbs: Group) -> Comparison:
    """Two-sided Wilcoxon rank-sum test of a controller against cDBS, or the check that failed."""
    plain = Comparison(tested.controller, tested.label, tested.n, cdbs.n)
    missing = not_enough(tested, cdbs)
    if missing:
        return replace(plain, note=missing)
    result = rank_sum(tested.values, cdbs.values, level=LEVEL)
    return replace(plain, p_value=result.p_value, method=result.method, difference=result.shift, low=result.low, high=result.high)


def smallest_p(n_x: int, n_y: int) -> float:
    """The smallest two-sided p that the exact test of so many sessions can give: both most extreme of all equally likely rankings."""
    return min(1.0, 2 / comb(n_x + n_y, n_x))


def sessions_needed(n_other: int) -> int | None:
    """The fewest sessions that can reach p < .05 against `n_other` sessions; None where the other side has none."""
    if n_other < 1:
        return None
    n = 1
    while smallest_p(n, n_other) >= ALPHA:
        n += 1
    return n


def not_enough(tested: Group, cdbs: Group) -> str:
    """Why the test is not made: the numbers of sessions cannot give p < .05 whatever the values are. Empty where they can."""
    if smallest_p(tested.n, cdbs.n) < ALPHA:
        return ""
    found = f"{tested.label} has {tested.n}, {cdbs.label} {cdbs.n}"
    if min(tested.n, cdbs.n) == 0:
        return f"needs at least 4 sessions with this metric on each side; {found}"
    needed = sessions_needed(cdbs.n)
    unequal = "" if needed == cdbs.n else f", or {needed} against {cdbs.n}"
    return (
        f"needs at least 4 sessions on each side{unequal}; {found}. "
        f"So few cannot give a two-sided p below {p_text(smallest_p(tested.n, cdbs.n))}"
    )


def adjust(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Fill in `p_holm` over all tests that were made."""
    made = [c.p_value for c in comparisons if c.p_value is not None]
    adjusted = iter(holm(made))
    return [c if c.p_value is None else replace(c, p_holm=next(adjusted)) for c in comparisons]
