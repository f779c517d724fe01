"""The rank-sum test against printed results of R's `coin::wilcox_test(..., distribution = "exact")`; R itself was not at hand.

Where ties meet groups of unequal size, coin's two-sided p counts every outcome that lies as far from the mean as the observed one; ours
doubles the smaller tail.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import rankdata

from ml.statistics.ranksum import rank_sum, u_distribution_given_ties


@dataclass(frozen=True)
class Printed:
    """One printed result: two-sided p, and the shift with its 95 % interval where it was asked for."""

    source: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    p_value: float
    doubled: bool
    interval: tuple[float, float, float] | None = None


TABLE = (
    Printed(
        "coin 1.1-0 (2015), log of its own regression tests; example of Bauer 1972",
        (6, 20, 27, 38, 46, 51, 54, 57), (10, 12, 15, 21, 32, 40, 41, 45), 0.2345, True, (-7, 11.5, 31),
    ),
    Printed(
        "coin, help page of its location tests; Hollander and Wolfe 1999, table 4.1 (the version is not printed)",
        (0.88, 0.90, 0.74, 1.21, 1.15), (0.80, 0.83, 1.89, 1.04, 1.45, 1.38, 1.91, 1.64, 0.73, 1.46), 0.2544, True, (-0.76, -0.305, 0.15),
    ),
    Printed(
        "coin 1.4-3, help page of the data; Bergmann, Ludbrook and Spooren 2000: 19 of 24 at the ceiling of 300 s, five below in one group",
        (300,) * 12, (1, 2, 3, 4, 5, *(300,) * 7), 0.03727, True,
    ),
    Printed(
        "coin (2019, the version is not printed), readme of the package brunnermunzel; pain scores of Brunner and Munzel 2000",
        (1, 2, 1, 1, 1, 1, 1, 1, 1, 1, 2, 4, 1, 1), (3, 3, 4, 3, 1, 2, 3, 1, 1, 5, 4), 0.00669, False,
    ),
)  # fmt: skip


@pytest.mark.parametrize("printed", TABLE, ids=lambda p: p.source.split(";")[0])
def test_p_and_interval_are_those_that_coin_printed(printed: Printed) -> None:
    found = rank_sum(printed.x, printed.y)
    assert found.method == "exact"
    if printed.doubled:
        assert found.p_value == pytest.approx(printed.p_value, abs=5e-5)
    if printed.interval:
        assert (found.low, found.shift, found.high) == pytest.approx(printed.interval)


@pytest.mark.parametrize("printed", TABLE, ids=lambda p: p.source.split(";")[0])
def test_the_exact_distribution_gives_coins_own_two_sided_p(printed: Printed) -> None:
    sizes = np.unique(rankdata([*printed.x, *printed.y]), return_counts=True)[1]
    n_x, n_y = len(printed.x), len(printed.y)
    probability = u_distribution_given_ties(n_x, tuple(int(s) for s in sizes))
    away = np.abs(np.arange(probability.size) / 2 - n_x * n_y / 2)
    observed = abs(rank_sum(printed.x, printed.y).u - n_x * n_y / 2)
    assert probability[away >= observed - 1e-9].sum() == pytest.approx(printed.p_value, abs=5e-5)


def test_doubling_the_smaller_tail_is_the_more_careful_of_the_two() -> None:
    for printed in TABLE:
        assert rank_sum(printed.x, printed.y).p_value >= printed.p_value - 5e-5
