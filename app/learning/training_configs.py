"""Names of the files that training steps leave in their folders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from app.learning.schemas import DistilParams, TrainParams

POLICY, CLONE = "policy.onnx", "clone.onnx"


def policy_file(member: int) -> str:
    """Name a trained policy's file in the folder of its step."""
    return f"policy-{member}.onnx"


def training_file(member: int) -> str:
    """Name a whole training's file in the folder of its step."""
    return f"training-{member}.pt"


# From what a job was asked for to the hyper-parameters of each policy. Plain dictionaries: the service need not load the learners.

TRAINING: dict[str, dict[str, Any]] = {
    # from scratch as in the paper: learning rates from 1e-5 to 1e-3
    "full": {"updates": 10_000, "batch": 64, "low": 1e-5, "high": 1e-3, "critic_lr": 1e-3},
    # For the demo. With 2000 updates at 1e-4 to 1e-3 all six policies of P1 ended at one amplitude, which the saturation curve shows. The
    # values here were chosen after seeing true returns of that synthetic participant too. So they are no evidence of how well DDPG learns.
    "quick": {"updates": 4_000, "batch": 64, "low": 1e-5, "high": 3e-4, "critic_lr": 1e-3},
}
CONSTRAINED = {"low": 1e-4, "high": 1e-3}
"""Learning rates of the other algorithms: around the 3e-4 of their publications."""

ANCHORED = ("td3_bc", "rebrac")
"""Algorithms whose policies stay near an amplitude."""

BEST = "best"
"""As `anchor` of a configuration: near the best constant amplitude, which the child process finds before it trains."""

CLOSE: dict[str, dict[str, Any]] = {"td3_bc": {"alpha": 1.25}, "rebrac": {"actor_penalty": 0.8}}
"""Strength that keeps policies near the best constant amplitude. At the published strength the critic took them to doses that no session
supports (docs/learning.md). Its rewards miss most of what a dose does to symptoms."""

LOOSE: dict[str, dict[str, Any]] = {"td3_bc": {"alpha": 2.5}, "rebrac": {"actor_penalty": 0.2}}
"""The same with more room for what the values say; still firmer than ReBRAC's published 0.05."""

HELD_BY = ("anchor", "anchor_amplitude", "alpha", "actor_penalty")
"""Members of a configuration that state a policy's anchor, and its strength."""

FINE_TUNING = {"low": 1e-7, "high": 1e-5}
"""The paper's learning rates when going on from a tested policy."""

DISTILLATION: dict[str, dict[str, Any]] = {"full": {"updates": 5_000, "sigma": 0.3}, "quick": {"updates": 1_500, "sigma": 0.3}}


def training_groups(params: TrainParams, starts: Sequence[dict[str, Any] | None]) -> list[dict[str, Any]]:
    """Group the policies of a sweep; each group is trained side by side, in a child process of its own.

    From scratch the policies are dealt to the algorithms in turn; each algorithm goes through its aims and anchors. Those of one algorithm
    have learning rates spread evenly in the logarithm, whatever their aims and anchors. Those of one kind fill two groups, one for each
    core. Seeds count up over all. A fine-tuned policy is a group of its own.

    Args:
        params: what was asked for.
        starts: one for each policy. None from scratch; else `policy_id`, `algorithm`, the hash of the parent's file, and `trained_with`.
            The last has the aim and the anchor of the parent's own training where it had any.

    Returns:
        For each group: `key` of its step, `algorithm`, `configs` (members of the algorithm's configuration), `start`.
    """
    if params.policies:
        return [_fine_tuning(params, k, start) for k, start in enumerate(starts) if start is not None]
    groups: list[dict[str, Any]] = []
    kinds = _kinds(params)
    algorithms = [kinds[number % len(kinds)][0] for number in range(params.count)]
    for which, (algorithm, changes) in enumerate(kinds):
        low, high = _rates(params, algorithm)
        configs = [
            _config(params, algorithm, actor_lr=_between(low, high, place, algorithms.count(algorithm)), seed=params.seed + number)
            | changes
            for number, place in ((n, algorithms[:n].count(algorithm)) for n in range(which, params.count, len(kinds)))
        ]
        half = -(-len(configs) // 2)
        groups += [{"algorithm": algorithm, "configs": part, "start": None} for part in (configs[:half], configs[half:]) if part]
    return [{"key": f"train/{k}"} | group for k, group in enumerate(groups)]


def generation_groups(params: TrainParams, parents: Sequence[dict[str, Any]], each: int) -> list[dict[str, Any]]:
    """Group the policies of a next generation: `each` policies fine-tuned from every parent, then `params.count` from scratch.

    The rates of fine-tuning are dealt to the parents in turn, so that no parent has the slow ones alone. Seeds count up over all.

    Args:
        params: of those from scratch. parents: as `starts` of `training_groups`. each: at least 1.
    """
    starts = [*parents] * each
    own_rates = {"actor_lr_low": None, "actor_lr_high": None}
    tuned = training_groups(params.model_copy(update={"policies": [s["policy_id"] for s in starts]} | own_rates), starts)
    fresh = training_groups(params.model_copy(update={"policies": [], "seed": params.seed + len(starts)}), [None] * params.count)
    return [group | {"key": f"train/{k}"} for k, group in enumerate([*tuned, *fresh])]


def fresh_rates(params: TrainParams) -> tuple[float, float]:
    """Find the lowest and highest learning rate of the policies that are trained from scratch, over all algorithms."""
    each = [_rates(params, algorithm) for algorithm in params.algorithms]
    return min(low for low, _ in each), max(high for _, high in each)


def _kinds(params: TrainParams) -> list[tuple[str, dict[str, Any]]]:
    """List kinds of policies in the order of dealing: every algorithm once before any has a second aim or anchor."""
    aims = ("steps", "return") if params.aim == "both" else (params.aim,)
    # Cloning knows no reward, so that its aims would be twins.
    each = {a: _variants(aims if a != "cloning" else ("steps",), _anchors(params, a)) for a in dict.fromkeys(params.algorithms)}
    most = max(len(variants) for variants in each.values())
    return [(a, variants[turn]) for turn in range(most) for a, variants in each.items() if turn < len(variants)]


def _fine_tuning(params: TrainParams, k: int, start: dict[str, Any]) -> dict[str, Any]:
    low, high = _rates(params, start["algorithm"])
    rate = _between(low, high, k, len(params.policies))
    config = _config(params, start["algorithm"], actor_lr=rate, seed=params.seed + k)
    asked: dict[str, Any] = {"aim": "return" if params.aim == "return" else "steps"} | _anchors(params, start["algorithm"])[0]
    # Alternating means what the parent had: its critics sum that aim, and another anchor would undo what was tested.
    turns = (("aim",) if params.aim == "both" else ()) + (HELD_BY if params.anchor in ("both", "all") else ())
    kept = {name: value for name, value in start.get("trained_with", {}).items() if name in turns}
    config |= asked | kept
    return {"key": f"train/{k}", "algorithm": start["algorithm"], "configs": [config], "start": start}


def _variants(aims: Sequence[str], anchors: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """List every pair of an aim and an anchor. Both change from one to the next, so that few policies have all aims and all anchors."""
    n, again = len(aims), math.lcm(len(aims), len(anchors))
    return [{"aim": aims[(k + k // again) % n]} | anchors[k % len(anchors)] for k in range(n * len(anchors))]


def _anchors(params: TrainParams, algorithm: str) -> list[dict[str, Any]]:
    """List the anchors of an algorithm's policies, as members of its configuration; the best constant amplitude first, and twice."""
    if algorithm not in ANCHORED:
        return [{}]
    logged: dict[str, Any] = {"anchor": "logged"}
    cdbs: dict[str, Any] = {"anchor": "constant", "anchor_amplitude": 1.0}
    close, loose = ({"anchor": BEST} | strength[algorithm] for strength in (CLOSE, LOOSE))
    return {
        "logged": [logged],
        "cdbs": [cdbs],
        "best": [close, loose],
        "both": [logged, cdbs],
        "all": [close, logged, cdbs, loose],
    }[params.anchor]


def _rates(params: TrainParams, algorithm: str) -> tuple[float, float]:
    """Return the lowest and highest learning rate of the policies."""
    spread = FINE_TUNING if params.policies else TRAINING[params.preset] if algorithm == "ddpg" else CONSTRAINED
    low = spread["low"] if params.actor_lr_low is None else params.actor_lr_low
    high = spread["high"] if params.actor_lr_high is None else params.actor_lr_high
    return low, high


def _config(params: TrainParams, algorithm: str, *, actor_lr: float, seed: int) -> dict[str, Any]:
    preset = TRAINING[params.preset]
    updates = preset["updates"] if params.updates is None else params.updates
    every = max(1, updates // 100)
    config = {
        "updates": updates,
        "batch": preset["batch"] if params.batch is None else params.batch,
        "actor_lr": actor_lr,
        "seed": seed,
        "record_every": every,
        "checkpoint_every": max(200, 5 * every),
        "device": "auto",
    }
    if algorithm != "cloning":
        config["critic_lr"] = preset["critic_lr"] if params.critic_lr is None else params.critic_lr
        config["critic_memory"] = params.critic_memory
    return config


def distillation_config(params: DistilParams, k: int) -> dict[str, Any]:
    """Choose hyper-parameters of the k-th student (`DistilConfig`)."""
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
    """Compute the k-th of n values from low to high, evenly spread in the logarithm; the middle where there is one alone."""
    share = 0.5 if n == 1 else k / (n - 1)
    return float(f"{math.exp(math.log(low) + share * (math.log(high) - math.log(low))):.3g}")
