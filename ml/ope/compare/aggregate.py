"""One estimate from several methods: the convex combination of least estimated error. Source: OPERA, Nie et al. 2024.

The error of a combination is estimated from refits on resampled sessions, which see variance and not bias. The bias that held-out
controllers showed of each method is added where it is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ml.ope.estimate import LEVEL, Estimate
from ml.ope.flags import distinct
from ml.ope.registry import AGGREGATE
from ml.ope.registry import methods as methods_of_all
from ml.statistics.bootstrap import percentile_interval

Floats = NDArray[np.float64]


def error_matrix(estimates: Mapping[str, Mapping[str, Estimate]], methods: list[str], bias: Mapping[str, float] | None = None) -> Floats:
    """Estimate the mean product of the errors of two methods, averaged over policies, [M, M].

    Draws of two methods count together where both name the same resamples of the sessions (`resampled`), because the first ones are then
    the same sessions. Draws from a posterior or of an ensemble match no others, and their chance products are no covariance. Such methods,
    and those that keep no draws, have the square of their standard error alone.
    """
    policies = common_policies(estimates, methods)
    total = np.zeros((len(methods), len(methods)))
    for name in policies:
        kept = [np.asarray(estimates[m][name].details.get("draws") or [], dtype=np.float64) for m in methods]
        for i, one in enumerate(kept):
            total[i, i] += estimates[methods[i]][name].standard_error ** 2
            for j, other in enumerate(kept[:i]):
                size = min(one.size, other.size)
                if size >= 20 and _same_resamples(estimates[methods[i]][name], estimates[methods[j]][name]):
                    together = float(np.mean((one[:size] - one[:size].mean()) * (other[:size] - other[:size].mean())))
                    total[i, j] += together
                    total[j, i] += together
    total /= max(len(policies), 1)
    squares = np.array([(bias or {}).get(m, 0.0) ** 2 for m in methods])
    return np.asarray(total + np.diag(squares), dtype=np.float64)


def _same_resamples(one: Estimate, other: Estimate) -> bool:
    """Decide whether the draws of two estimates were made on the same resamples of the same sessions."""
    mine = one.details.get("resampled")
    return mine is not None and mine == other.details.get("resampled")


def convex_weights(errors: Floats) -> Floats:
    """Compute the weights that minimise w^T errors w, not negative and summing to 1, [M]."""
    values, vectors = np.linalg.eigh(0.5 * (errors + errors.T))
    size = float(np.abs(values).max())
    if size == 0:
        return np.full(len(errors), 1 / len(errors))
    root = np.sqrt(np.maximum(values, 1e-9 * size))[:, None] * vectors.T / np.sqrt(size)
    # One heavy row asks for a sum of 1; dividing by the sum afterwards makes it exact.
    heavy = 1e4
    weights, _ = scipy.optimize.nnls(np.vstack([root, np.full((1, len(errors)), heavy)]), np.append(np.zeros(len(errors)), heavy))
    return np.asarray(weights / weights.sum(), dtype=np.float64)


def common_policies(estimates: Mapping[str, Mapping[str, Estimate]], methods: list[str]) -> list[str]:
    """List the policies that every method has estimated, in the order of the first."""
    return [p for p in estimates[methods[0]] if all(p in estimates[m] for m in methods)]


def combine(estimates: Mapping[str, Mapping[str, Estimate]], bias: Mapping[str, float] | None = None) -> dict[str, Estimate]:
    """Combine the estimates of every policy.

    Args:
        estimates: method -> policy -> estimate. A method takes part when it is supported for at least one policy; combinations, and
            methods that run only where they are named, do not.
        bias: root mean squared error of each method on left-out controllers, unit of the return.

    Raises:
        ValueError: no method takes part, or no policy has been estimated by all that do.
    """
    apart = {m.key for m in methods_of_all() if m.family == "combination" or not m.combines}
    methods = [m for m, table in estimates.items() if m not in apart and any(e.supported for e in table.values())]
    if not methods:
        raise ValueError("nothing to combine: no method supports any policy")
    policies = common_policies(estimates, methods)
    if not policies:
        raise ValueError(f"nothing to combine: no policy has been estimated by all of {', '.join(methods)}")
    weights = convex_weights(error_matrix(estimates, methods, bias))
    return {name: _combined([estimates[m][name] for m in methods], methods, weights) for name in policies}


def _combined(parts: list[Estimate], methods: list[str], weights: Floats) -> Estimate:
    value = float(sum(w * p.value for w, p in zip(weights, parts, strict=True)))
    step = float(sum(w * p.step_return for w, p in zip(weights, parts, strict=True)))
    used = [p for w, p in zip(weights, parts, strict=True) if w > 1e-6]
    drawn = [np.asarray(p.details.get("draws") or [], dtype=np.float64) for p in used]
    size = min(d.size for d in drawn)
    if size >= 20:
        shares = weights[weights > 1e-6]
        draws = sum(w * (d[:size] - d[:size].mean()) for w, d in zip(shares, drawn, strict=True)) + value
    else:
        spread = float(np.sqrt(sum((w * p.standard_error) ** 2 for w, p in zip(weights, parts, strict=True))))
        draws = value + spread * np.random.default_rng(0).standard_normal(200)
    interval = percentile_interval(np.asarray(draws), LEVEL)
    # Where the methods disagree by more than their own intervals say, the combination must not look surer than they are apart.
    between = float(np.sqrt(sum(w * (p.value - value) ** 2 for w, p in zip(weights, parts, strict=True))))
    main = used[int(np.argmax([w for w in weights if w > 1e-6]))]
    return replace(
        main,
        method=AGGREGATE,
        value=value,
        low=min(interval.low, value - 1.645 * between),
        high=max(interval.high, value + 1.645 * between),
        standard_error=float(np.hypot(interval.standard_error, between)),
        step_return=step,
        end_reward=None if main.end_reward is None else value - step,
        supported=all(p.supported for p in used),
        flags=distinct(f for p in used for f in p.flags),
        details={
            "horizon_steps": main.details.get("horizon_steps"),
            "weights": {m: round(float(w), 4) for m, w in zip(methods, weights, strict=True)},
            "between_methods": between,
            "draws": [round(float(d), 4) for d in np.asarray(draws)],
        },
    )
