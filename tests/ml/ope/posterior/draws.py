"""Estimates with constructed posterior draws, in which every probability is known in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np

from ml.ope.estimate import Estimate
from ml.ope.flags import Flag

N = 1000
RANKS = (np.arange(N) + 0.5) / N
"""Draws of a uniform distribution without chance: the share below x is x."""

SUPPORT = {"near_sessions": 4, "near_visits": 2, "leverage": 0.1, "dose": 0.7, "lowest_supported": 0.5}


def share(of_ones: float, good: float, bad: float) -> list[float]:
    """Build draws of which a share is `bad` and the rest `good`."""
    return [float(v) for v in np.where(of_ones > RANKS, bad, good)]


def constructed(name: str = "rl", *, supported: bool = True, told: bool = True, value: float = 0.0, **changed: Any) -> Estimate:
    """Build a posterior estimate with skill: energy 0.6 of cDBS, grasp 2 Hz, rating 7, tremor 20 %; `changed` replaces details."""
    outcomes = {"energy": [0.6] * N, "grasp_hz": [2.0] * N, "rating": [7.0] * N, "tremor_percent": [20.0] * N}
    details: dict[str, Any] = {
        "draws": [value] * N,
        "outcome_draws": {k: v for k, v in (outcomes | changed.pop("outcome_draws", {})).items() if v is not None},
        "support": SUPPORT | changed.pop("support", {}),
        "behaviour": {"below_cdbs_20_percent": 0.0, "closeness_to_cdbs": 0.3, "mean_amplitude": 0.7} | changed.pop("behaviour", {}),
        "skill": {"told": told, "reasons": [] if told else ["no_better_than_equal"], "held_out_correlation": 0.7 if told else -0.1},
        "weights": {"linear": 1.0},
    }  # fmt: skip
    flags = () if supported else (Flag.of("thin", 0.4, 0.2, "share", refuses=True),)
    return Estimate("posterior", value, value - 1, value + 1, 0.9, 0.5, value, 0.0, {"energy": 0.6}, supported, flags, 12, details)


def cdbs(**changed: Any) -> Estimate:
    """Build cDBS for comparison: energy 1, the same outcomes."""
    same = {"energy": [1.0] * N} | changed.pop("outcome_draws", {})
    return constructed("cdbs", outcome_draws=same, behaviour={"closeness_to_cdbs": 0.0}, **changed)
