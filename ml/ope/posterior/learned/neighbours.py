"""What sessions with similar doses showed, without any model of beta: a Gaussian process on mean dose, late dose and switching.

It is the witness that assumes no mechanism: where structures and it agree, what they say is more likely to be true of patients whose
beta works in another way. Each quantity is a smooth function of the doses plus a level of the visit plus noise of the session. How large
these are, and how smooth the function is, is averaged over a grid by marginal likelihood (Rasmussen and Williams 2006, chapter 5).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LENGTHS = (np.array([0.2, 0.3, 0.1]), np.array([0.6, 0.9, 0.3]))
"""Distances of mean dose, late dose (fractions) and switching (mean change per step) over which the function changes."""
SIGNALS = (0.1, 0.3, 1.0)
NOISES = (0.1, 0.3, 1.0)
DAYS = (0.05, 0.4)
"""Standard deviations of the function, of a session and of a visit's level, in the quantity's unit."""
CENTRE = np.array([0.65, 0.65, 0.0])
SLOPE = np.array([1.5, 0.5, 1.0])
"""The function's prior has a line besides: its standard deviation per unit, in standard deviations of the function."""
FEWEST = 3


@dataclass(frozen=True)
class Contrast:
    """Difference of a quantity to what it is under a reference dose: mean and standard deviation of each of P policies, [P]."""

    mean: Floats
    sd: Floats


def contrasts(points: Floats, visits: NDArray[np.int64], values: Floats, unit: float, asked: Floats, reference: Floats) -> Contrast:
    """Contrasts of policies by sessions alone.

    Args:
        points: doses of sessions, [n, 3]. visits: of them, [n]. values: the quantity, [n]; NaN where not known.
        unit: a difference of it that would be large. asked: doses of policies, [P, 3]. reference: of the reference, [3].

    Returns:
        Zeros with the standard deviation of the prior where fewer than three values are known.
    """
    known = np.isfinite(values)
    if known.sum() < FEWEST:
        return Contrast(np.zeros(len(asked)), np.full(len(asked), unit * SIGNALS[1]))
    x, y, v = points[known], values[known] / unit, visits[known]
    y = y - y.mean()
    same, every = (v[:, None] == v).astype(np.float64), np.concatenate([asked, reference[None]])
    logs, means, variances = [], [], []
    for lengths in LENGTHS:
        within, across, there = _kernel(x, x, lengths), _kernel(every, x, lengths), _kernel(every, every, lengths)
        for signal, noise, day in product(SIGNALS, NOISES, DAYS):
            gram = signal**2 * within + day**2 * same + noise**2 * np.eye(y.size) + 1.0  # a level of its own
            lower = np.linalg.cholesky(gram)
            z = np.linalg.solve(lower, np.concatenate([y[:, None], signal**2 * (across[:-1] - across[-1]).T], axis=1))
            logs.append(-0.5 * float(z[:, 0] @ z[:, 0]) - float(np.log(np.diag(lower)).sum()))
            means.append(z[:, 1:].T @ z[:, 0])
            prior = signal**2 * (np.diag(there)[:-1] + there[-1, -1] - 2 * there[:-1, -1])
            variances.append(np.maximum(prior - (z[:, 1:] ** 2).sum(0), 0.0))
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    mean = weights @ np.stack(means)
    variance = weights @ (np.stack(variances) + (np.stack(means) - mean) ** 2)
    return Contrast(unit * mean, unit * np.sqrt(variance))


def _kernel(a: Floats, b: Floats, lengths: Floats) -> Floats:
    gap = (a[:, None] - b[None]) / lengths
    line = ((a - CENTRE) * SLOPE) @ ((b - CENTRE) * SLOPE).T
    return np.asarray(np.exp(-0.5 * (gap**2).sum(-1)) + line, dtype=np.float64)
