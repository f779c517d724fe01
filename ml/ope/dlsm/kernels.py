"""The recurrences of `dlsm_recurrence`, forwards and backwards, as one compiled loop over time each.

A step is a few small matrix products (BLAS) and about twenty elementwise operations. Called one by one from an interpreter, the calls cost
more than the arithmetic. Arrays are contiguous, time first, of one floating type. Gates have the order g, i, f, o.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numba.extending import overload

from ml.compiled import compiled

# No `nnan`: what is not a number must stay visible. `error_model="numpy"` below: a check for division by zero would bar vectorisation.
FAST_MATH = {"contract", "reassoc", "arcp", "nsz"}
_ONE, _HALF, _EDGE = np.float32(1), np.float32(0.5), np.float32(9)
# tanh x = x P(x^2) / Q(x^2) for |x| < 9, fitted by iteratively reweighted least squares; in float32 off by less than 3.1e-7 everywhere.
_P = tuple(np.float32(c) for c in (0.999999999, 0.136808887, 3.86954812e-3, 2.8032101e-5, 3.06443376e-8, -1.2247493e-11))
_Q = tuple(np.float32(c) for c in (1.0, 0.470142208, 2.72503043e-2, 3.94078346e-4, 1.28908915e-6))


def squash(x: Any) -> Any:
    """Compute tanh; in float32 by a rational function, which a compiler can vectorise."""
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


@compiled(inline="always")
def _quarters(row: Any, hidden: int) -> Any:
    """Return views of the four gates. An index like `hidden + j` could be negative as far as the compiler knows, which prevents
    vectorisation."""
    return row[:hidden], row[hidden : 2 * hidden], row[2 * hidden : 3 * hidden], row[3 * hidden : 4 * hidden]


@compiled(fastmath=FAST_MATH, error_model="numpy")
def _cell_forward(acts: Any, carried: Any, bias: Any, c: Any, c_next: Any, tanh_c: Any, h: Any) -> None:
    """Run one LSTM cell: gates [B, >= 4H], what is carried [B, >= 4H] and bias are added and squashed in place; the rest [B, H] is
    written."""
    batch, hidden = tanh_c.shape
    for b in range(batch):
        row, more = acts[b], carried[b]
        g, i, f, o = _quarters(row, hidden)
        logistic = row[hidden : 4 * hidden]
        before, after, squashed, out = c[b], c_next[b], tanh_c[b], h[b]
        # loops with few arrays each: with more, the compiler cannot prove them apart and does not vectorise
        for j in range(row.size):
            row[j] += more[j] + bias[j]
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


@compiled(fastmath=FAST_MATH, error_model="numpy")
def _cell_backward(d_h: Any, acts: Any, c: Any, tanh_c: Any, d_c: Any, d_acts: Any) -> None:
    """Compute gradients of a cell's gates before squashing, into the first 4H columns of `d_acts` [B, >= 4H]; `d_c` [B, H] is moved on to
    c."""
    batch, hidden = d_c.shape
    for b in range(batch):
        g, i, f, o = _quarters(acts[b], hidden)
        d_g, d_i, d_f, d_o = _quarters(d_acts[b], hidden)
        before, through, above, cell = c[b], tanh_c[b], d_h[b], d_c[b]
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


@compiled(fastmath=FAST_MATH, error_model="numpy")
def _latent_forward(
    heads: Any, b_out: Any, acts: Any, eps: Any, z: Any, mean: Any, log_std: Any, share: Any, std: Any, low: float, span: float
) -> None:
    """Draw z, with mean and standard deviation, [B, Z] each, from h's product [B, 2Z] and the skip path in the last Z columns of `acts`."""
    batch, latent = eps.shape
    skip = acts.shape[1] - latent
    for b in range(batch):
        for k in range(latent):
            inside = _HALF + _HALF * squash(_HALF * (heads[b, latent + k] + b_out[latent + k]))
            share[b, k] = inside
            log_std[b, k] = low + span * inside
            mean[b, k] = heads[b, k] + b_out[k] + acts[b, skip + k]
        for k in range(latent):
            std[b, k] = math.exp(log_std[b, k])
        for k in range(latent):
            z[b, k] = mean[b, k] + std[b, k] * eps[b, k]


@compiled(fastmath=FAST_MATH, error_model="numpy")
def _latent_backward(
    grad_z: Any, grad_mean: Any, grad_log_std: Any, share: Any, std: Any, eps: Any, d_carry: Any, d_head: Any, d_acts: Any, span: float
) -> None:
    """Compute gradients of the heads, into `d_head` [B, 2Z], and of the skip path, into the last Z columns of `d_acts`.

    `d_carry` [B, Z + H] is the gradient of (z, h) from the step that follows; the other gradients come from above.
    """
    batch, latent = eps.shape
    skip = d_acts.shape[1] - latent
    for b in range(batch):
        for k in range(latent):
            d_z = grad_z[b, k] + d_carry[b, k]
            d_mean = grad_mean[b, k] + d_z
            d_head[b, k] = d_mean
            d_head[b, latent + k] = (grad_log_std[b, k] + d_z * std[b, k] * eps[b, k]) * share[b, k] * (_ONE - share[b, k]) * span
            d_acts[b, skip + k] = d_mean


@compiled(fastmath=FAST_MATH, error_model="numpy")
def stochastic_forward(
    acts: Any, carry: Any, c: Any, tanh_c: Any, eps: Any, z: Any, mean: Any, log_std: Any, share: Any, std: Any,
    joint: Any, bias: Any, w_out: Any, b_out: Any, low: float, span: float,
) -> None:  # fmt: skip
    """Run all steps of the stochastic LSTM.

    Args:
        acts: [T, B, 4H + Z], input's share of gates and skip path; squashed gates afterwards.
        carry: [T + 1, B, Z + H], (z_t, h_t) with row 0 given. c: [T + 1, B, H] with row 0 given. tanh_c: [T, B, H], written.
        eps: noise. z, mean, log_std, share, std: written; share is the squashed raw log sigma in (0, 1). [T, B, Z] each.
        joint: [Z + H, 4H + Z], weights of gates and skip path. bias: [4H + Z]. w_out: [H, 2Z]. b_out: [2Z].
        low, span: lower bound and width of the bounds of log sigma.
    """
    steps, batch, latent = eps.shape
    product, h, heads = np.empty_like(acts[0]), np.empty_like(tanh_c[0]), np.empty((batch, 2 * latent), acts.dtype)
    for t in range(steps):
        np.dot(carry[t], joint, product)
        _cell_forward(acts[t], product, bias, c[t], c[t + 1], tanh_c[t], h)
        np.dot(h, w_out, heads)
        _latent_forward(heads, b_out, acts[t], eps[t], z[t], mean[t], log_std[t], share[t], std[t], low, span)
        carry[t + 1, :, :latent] = z[t]
        carry[t + 1, :, latent:] = h


@compiled(fastmath=FAST_MATH, error_model="numpy")
def stochastic_backward(
    grad_z: Any, grad_mean: Any, grad_log_std: Any, acts: Any, c: Any, tanh_c: Any, eps: Any, share: Any, std: Any,
    joint_t: Any, out_t: Any, d_acts: Any, d_heads: Any, d_carry: Any, d_c: Any, span: float,
) -> None:  # fmt: skip
    """Compute gradients of `stochastic_forward`, of all steps or of those after which `d_carry` and `d_c` are known.

    Args:
        grad_z, grad_mean, grad_log_std: from above, [T, B, Z].
        acts, c, tanh_c, eps, share, std: as the forward pass left them.
        joint_t, out_t: transposed weights, [4H + Z, Z + H] and [2Z, H].
        d_acts, d_heads: of gates and skip path [T, B, 4H + Z], and of the heads' products [T, B, 2Z]; written.
        d_carry, d_c: of (z, h), [B, Z + H], and c, [B, H], after the last step, zeros at the end; afterwards before the first.
        span: as there.
    """
    steps, _, latent = eps.shape
    d_h = np.empty_like(tanh_c[0])
    for back in range(steps):
        t = steps - 1 - back
        _latent_backward(grad_z[t], grad_mean[t], grad_log_std[t], share[t], std[t], eps[t], d_carry, d_heads[t], d_acts[t], span)
        np.dot(d_heads[t], out_t, d_h)
        d_h += d_carry[:, latent:]
        _cell_backward(d_h, acts[t], c[t], tanh_c[t], d_c, d_acts[t])
        np.dot(d_acts[t], joint_t, d_carry)


@compiled(fastmath=FAST_MATH, error_model="numpy")
def lstm_forward(acts: Any, h: Any, c: Any, tanh_c: Any, w_h: Any, bias: Any) -> None:
    """Run all steps of an LSTM. acts [T, B, 4H] has the input's share and is squashed; h, c [T + 1, B, H] have row 0; tanh_c [T, B, H]."""
    product = np.empty_like(acts[0])
    for t in range(len(acts)):
        np.dot(h[t], w_h, product)
        _cell_forward(acts[t], product, bias, c[t], c[t + 1], tanh_c[t], h[t + 1])


@compiled(fastmath=FAST_MATH, error_model="numpy")
def lstm_backward(grad_h: Any, acts: Any, c: Any, tanh_c: Any, back: Any, d_acts: Any, d_h: Any, d_c: Any) -> None:
    """Compute gradients of `lstm_forward`: `d_acts` [T, B, 4H] is written from `grad_h` [T, B, H] and the transposed weights `back` [4H,
    H].

    `d_h` and `d_c` [B, H] are those after the last step, zeros at the end; afterwards those before the first.
    """
    for k in range(len(acts)):
        t = len(acts) - 1 - k
        d_h += grad_h[t]
        _cell_backward(d_h, acts[t], c[t], tanh_c[t], d_c, d_acts[t])
        np.dot(d_acts[t], back, d_h)
