"""From what a job was asked for to the hyper-parameters of each policy. Plain dictionaries: the service need not load the learners."""

from __future__ import annotations

import math
from typing import Any

from app.learning.schemas import DistilParams, TrainParams

TRAINING: dict[str, dict[str, Any]] = {
    # from scratch as in the paper: learning rates from 1e-5 to 1e-3
    "full": {"updates": 10_000, "batch": 64, "low": 1e-5, "high": 1e-3, "critic_lr": 1e-3},
    # For the demo. With 2000 updates at 1e-4 to 1e-3 all six policies of P1 ended at one amplitude, which the saturation curve shows; the
    # values here were picked after seeing true returns of that synthetic participant too, so they are no evidence of how well DDPG learns.
    "quick": {"updates": 4_000, "batch": 64, "low": 1e-5, "high": 3e-4, "critic_lr": 1e-3},
}
FINE_TUNING = {"low": 1e-7, "high": 1e-5}
"""The paper's learning rates when going on from a tested policy."""

DISTILLATION: dict[str, dict[str, Any]] = {"full": {"updates": 5_000, "sigma": 0.3}, "quick": {"updates": 1_500, "sigma": 0.3}}


def training_configs(params: TrainParams) -> list[dict[str, Any]]:
    """Hyper-parameters of each policy (`DdpgConfig`): the policies' learning rates spread evenly in the logarithm, seeds counting up."""
    preset = TRAINING[params.preset]
    spread = FINE_TUNING if params.policies else preset
    low = spread["low"] if params.actor_lr_low is None else params.actor_lr_low
    high = spread["high"] if params.actor_lr_high is None else params.actor_lr_high
    n = len(params.policies) or params.count
    common = {
        "updates": preset["updates"] if params.updates is None else params.updates,
        "batch": preset["batch"] if params.batch is None else params.batch,
        "critic_lr": preset["critic_lr"] if params.critic_lr is None else params.critic_lr,
    }
    every = max(1, common["updates"] // 100)
    return [
        common
        | {"actor_lr": _between(low, high, k, n), "seed": params.seed + k, "record_every": every, "checkpoint_every": max(200, 5 * every)}
        for k in range(n)
    ]


def distillation_config(params: DistilParams, k: int) -> dict[str, Any]:
    """Hyper-parameters of the k-th student (`DistilConfig`)."""
    preset = DISTILLATION[params.preset]
    updates = preset["updates"] if params.updates is None else params.updates
    config = {
        "updates": updates,
        "sigma": preset["sigma"] if params.sigma is None else params.sigma,
        "seed": params.seed + k,
        "record_every": max(1, updates // 100),
    }
    return config | ({"hidden": list(params.hidden)} if params.hidden else {})


def _between(low: float, high: float, k: int, n: int) -> float:
    """The k-th of n values from low to high, evenly spread in the logarithm; the middle where there is one alone."""
    share = 0.5 if n == 1 else k / (n - 1)
    return float(f"{math.exp(math.log(low) + share * (math.log(high) - math.log(low))):.3g}")
