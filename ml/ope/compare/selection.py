"""Choice of a policy from estimates alone, if any: by the lower bound of the gain over a reference, such as cDBS.

The best of several noisy estimates is the luckiest as much as the best. Two things keep luck out. Draws of one method share their resampled
sessions over all policies, so what a good day adds to every policy cancels in a difference. The bound, not the estimate, is compared, so
that an uncertain policy does not win by its uncertainty. Lower bounds as the criterion of deployment: Thomas, Theocharous and Ghavamzadeh,
AAAI 2015. Where no bound is above the reference, nothing is chosen.
"""

from __future__ import annotations

from collections.abc import Mapping

from ml.returns import Gain


def surest(gains: Mapping[str, Gain]) -> str | None:
    """Name the policy with the largest lower bound of its gain over the reference; None where no bound is above 0.

    Bounds are not corrected for their number: the best of many is above 0 by luck more often than one.
    """
    best = max(gains, key=lambda name: gains[name].low, default=None)
    return best if best is not None and gains[best].low > 0 else None
