"""Everything of an LSTM step that is no matrix product, as one compiled loop per step and direction.

A step of the recurrences in `dlsm_recurrence` is a few small matrix products and about twenty elementwise operations; called one by one,
the latter cost more than the products. Each kernel here does all of them in one pass over [B, H], on whole arrays [T, B, ...] and a step
number, so that nothing has to be sliced. Gates stand in the order g, i, f, o.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import overload

# No `nnan`: what is not a number must stay visible. `error_model="numpy"` below: a check for division by zero would bar vectorisation.
_FAST = {"contract", "reassoc", "arcp", "nsz"}
_ONE, _HALF, _EDGE = np.float32(1), np.float32(0.5), np.float32(9)
# tanh x = x P(x^2) / Q(x^2) for |x| < 9, fitted by iteratively reweighted least squares; in float32 off by less than 3.1e-7 everywhere.
_P = tuple(np.float32(c) for c in (0.999999999, 0.136808887, 3.86954812e-3, 2.8032101e-5, 3.06443376e-8, -1.2247493e-11))
_Q = tuple(np.float32(c) for c in (1.0, 0.470142208, 2.72503043e-2, 3.94078346e-4, 1.28908915e-6))


def squash(x: Any) -> Any:
    """tanh; in float32 by a rational function, which a compiler can vectorise."""
    return math.tanh(x)


@overload(squash)
def _squash_by_type(x: Any) -> Any:
    return _rational_tanh if x == types.float32 else _exact_tanh


def _exact_tanh(x: Any) -> Any:
    return math.tanh(x)


def _rational_tanh(x: Any) -> Any:
    y = x
    if y > _EDGE:
        y = _EDGE
    if y < -_EDGE:
        y = -_EDGE
    u = y * y
    above = _P[0] + u * (_P[1] + u * (_P[2] + u * (_P[3] + u * (_P[4] + u * _P[5]))))
    return y * above / (_Q[0] + u * (_Q[1] + u * (_Q[2] + u * (_Q[3] + u * _Q[4]))))


@njit(cache=True, inline="always")
def _quarters(row: Any, hidden: int) -> Any:
    """Views of the four gates: an index like `hidden + j` could be negative for all the compiler knows, which bars vectorisation."""
    return row[:hidden], row[hidden : 2 * hidden], row[2 * hidden : 3 * hidden], row[3 * hidden : 4 * hidden]


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def cell_forward(t: int, acts: Any, c: Any, tanh_c: Any, h: Any, offset: int) -> None:
    """One LSTM cell in place.

    Args:
        t: step, 0-based.
        acts: [T, B, >= 4H], the gates of step t before squashing; squashed afterwards.
        c: [T + 1, B, H] with c_0 in row 0; row t + 1 is written. tanh_c: [T, B, H], row t is written.
        h: [T + 1, B, offset + H]; columns from `offset` on of row t + 1 are written.
    """
    batch, hidden = tanh_c.shape[1], tanh_c.shape[2]
    for b in range(batch):
        g, i, f, o = _quarters(acts[t, b], hidden)
        logistic = acts[t, b, hidden : 4 * hidden]
        before, after, squashed, out = c[t, b], c[t + 1, b], tanh_c[t, b], h[t + 1, b, offset:]
        # loops with few arrays each: with more, the compiler cannot prove them apart and does not vectorise
        for j in range(hidden):
            g[j] = squash(g[j])
        for j in range(3 * hidden):
            logistic[j] = _HALF + _HALF * squash(_HALF * logistic[j])
        for j in range(hidden):
            after[j] = f[j] * before[j] + i[j] * g[j]
        for j in range(hidden):
            squashed[j] = squash(after[j])
        for j in range(hidden):
            out[j] = o[j] * squashed[j]


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def latent_forward(t: int, heads: Any, acts: Any, eps: Any, std: Any, carry: Any, low: float, high: float) -> None:
    """Mean, standard deviation and draw of z_{t+1}.

    Args:
        t: step, 0-based.
        heads: [T, B, 2Z], mean and raw log sigma from h; afterwards the mean with its skip path, and the squashed raw value in (0, 1).
        acts: [T, B, 4H + Z], whose last Z columns are the skip path. eps: noise, [T, B, Z]. std: [T, B, Z], row t is written.
        carry: [T + 1, B, Z + H], whose first Z columns of row t + 1 are written.
        low, high: bounds of log sigma.
    """
    batch, latent = eps.shape[1], eps.shape[2]
    skip = acts.shape[2] - latent
    for b in range(batch):
        for k in range(latent):
            mean = heads[t, b, k] + acts[t, b, skip + k]
            share = _HALF + _HALF * squash(_HALF * heads[t, b, latent + k])
            sigma = math.exp(low + (high - low) * share)
            heads[t, b, k] = mean
            heads[t, b, latent + k] = share
            std[t, b, k] = sigma
            carry[t + 1, b, k] = mean + sigma * eps[t, b, k]


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def latent_backward(
    t: int,
    grad_z: Any,
    grad_mean: Any,
    grad_log_std: Any,
    heads: Any,
    std: Any,
    eps: Any,
    d_carry: Any,
    d_head: Any,
    d_acts: Any,
    span: float,
) -> None:
    """Gradients of the heads of step t, written to `d_head` [T, B, 2Z], and of the skip path, written to the last Z columns of `d_acts`.

    Args:
        grad_z, grad_mean, grad_log_std: from above, [T, B, Z]. d_carry: of (z_{t+1}, h_{t+1}) from step t + 1, [B, Z + H].
        heads, std, eps: as `latent_forward` left them. span: width of the bounds of log sigma.
    """
    batch, latent = eps.shape[1], eps.shape[2]
    skip = d_acts.shape[2] - latent
    for b in range(batch):
        for k in range(latent):
            d_z = grad_z[t, b, k] + d_carry[b, k]
            share = heads[t, b, latent + k]
            slope = share * (_ONE - share) * span
            d_mean = grad_mean[t, b, k] + d_z
            d_head[t, b, k] = d_mean
            d_head[t, b, latent + k] = (grad_log_std[t, b, k] + d_z * std[t, b, k] * eps[t, b, k]) * slope
            d_acts[t, b, skip + k] = d_mean


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def cell_backward(t: int, d_h: Any, acts: Any, c: Any, tanh_c: Any, d_c: Any, d_acts: Any) -> None:
    """Gradients of the gates of step t before squashing, written to the first 4H columns of `d_acts` [T, B, >= 4H].

    Args:
        d_h: of h_{t+1}, [B, H]. d_c: of c_{t+1} from later steps, [B, H]; afterwards of c_t.
        acts, c, tanh_c: as `cell_forward` left them.
    """
    batch, hidden = d_c.shape
    for b in range(batch):
        g, i, f, o = _quarters(acts[t, b], hidden)
        d_g, d_i, d_f, d_o = _quarters(d_acts[t, b], hidden)
        before, through, above, cell = c[t, b], tanh_c[t, b], d_h[b], d_c[b]
        for j in range(hidden):
            cell[j] += above[j] * o[j] * (_ONE - through[j] * through[j])
        for j in range(hidden):
            d_o[j] = above[j] * through[j] * o[j] * (_ONE - o[j])
        for j in range(hidden):
            d_g[j] = cell[j] * i[j] * (_ONE - g[j] * g[j])
        for j in range(hidden):
            d_i[j] = cell[j] * g[j] * i[j] * (_ONE - i[j])
        for j in range(hidden):
            d_f[j] = cell[j] * before[j] * f[j] * (_ONE - f[j])
        for j in range(hidden):
            cell[j] *= f[j]
