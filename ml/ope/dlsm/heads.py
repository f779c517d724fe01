"""Gaussian heads of the deep latent models: readable, and as one function with hand-written derivatives for training.

Every density is a diagonal Gaussian over standardised variables with bounded log standard deviation.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from ml.compiled import compiled
from ml.ope.dlsm.kernels import FAST_MATH, squash
from ml.ope.dlsm.recurrence import LOG_STD_BOUNDS, bounded

_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)

ROWS = 1024
"""Rows that pass through all layers of a head before the next ones do, so that they are still in the cache."""


def gaussian_log_prob(x: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """log N(x; mean, exp(log_std)^2), elementwise."""
    return -0.5 * ((x - mean) * torch.exp(-log_std)).square() - log_std - _HALF_LOG_TWO_PI


def gaussian_kl(mean_q: Tensor, log_std_q: Tensor, mean_p: Tensor, log_std_p: Tensor) -> Tensor:
    """Compute KL(q || p) = E_q[log q - log p] of diagonal Gaussians, elementwise; at least 0 (the paper's appendix has the sign
    reversed)."""
    ratio = torch.exp(2 * (log_std_q - log_std_p))
    shift = ((mean_q - mean_p) * torch.exp(-log_std_p)).square()
    return 0.5 * (ratio + shift - 1) - (log_std_q - log_std_p)


class GaussianHead(nn.Module):
    """Mean and bounded log standard deviation as an affine map plus a feed-forward network that starts at zero."""

    def __init__(self, n_in: int, n_out: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.affine = nn.Linear(n_in, 2 * n_out)
        layers: list[nn.Module] = []
        width = n_in
        for size in hidden:
            layers += [nn.Linear(width, size), nn.ELU()]
            width = size
        self.body: nn.Module | None = None
        if layers:
            last = nn.Linear(width, 2 * n_out)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
            self.body = nn.Sequential(*layers, last)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Compute mean and log standard deviation, each [..., n_out], for x [..., n_in]."""
        raw = self.affine(x)
        if self.body is not None:
            raw = raw + self.body(x)
        mean, log_std = raw.chunk(2, dim=-1)
        return mean, bounded(log_std)

    def log_prob(self, x: Tensor, target: Tensor, fast: bool = True) -> Tensor:
        """log p(target | x) summed over the last axis, [...], for x [..., n_in] and target [..., n_out]."""
        if not fast:
            return gaussian_log_prob(target, *self(x)).sum(-1)
        weights: list[Tensor] = [self.affine.weight, self.affine.bias]
        if self.body is not None:
            for layer in self.body.children():
                if isinstance(layer, nn.Linear):
                    weights += [layer.weight, layer.bias]
        rows: Tensor = _HeadLogProb.apply(x.reshape(-1, x.shape[-1]), target.reshape(-1, target.shape[-1]), *weights)
        return rows.view(x.shape[:-1])


class _HeadLogProb(torch.autograd.Function):
    """log p of rows, [N], by a head given as its affine map and its layers; the targets are data and have no gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, target: Tensor, *weights: Tensor) -> Tensor:
        (affine, bias), layers = weights[:2], _pairs(weights[2:])
        n, out = target.shape
        inner = [x.new_empty(n, w.shape[0]) for w, _ in layers[:-1]]
        residual, share, inverse = (x.new_empty(n, out) for _ in range(3))
        log_prob = x.new_empty(n)
        low, high = LOG_STD_BOUNDS
        if layers:
            bias = bias + layers[-1][1]
        target = target.contiguous()
        for rows in _rows(n):
            given = x[rows]
            raw = torch.mm(given, affine.t())
            for (w, b), kept in zip(layers[:-1], inner, strict=True):
                given = torch.mm(given, w.t(), out=kept[rows])
                _elu(given.numpy(), b.detach().numpy())
            if layers:
                raw.addmm_(given, layers[-1][0].t())
            kept_rows = (t[rows].numpy() for t in (target, residual, share, inverse, log_prob))
            _density(raw.numpy(), bias.detach().numpy(), *kept_rows, low, high - low)
        ctx.inner = len(inner)
        ctx.save_for_backward(x, residual, share, inverse, *inner, *weights)
        return log_prob

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, residual, share, inverse, *rest = ctx.saved_tensors
        inner, weights = rest[: ctx.inner], rest[ctx.inner :]
        (affine, _), layers = weights[:2], _pairs(weights[2:])
        grad = grads[0].contiguous()
        sums = [torch.zeros_like(w) for w in weights]
        d_x = torch.empty_like(x)
        span = LOG_STD_BOUNDS[1] - LOG_STD_BOUNDS[0]
        d_raw_room = x.new_empty(min(ROWS, len(x)), 2 * residual.shape[1])
        for rows in _rows(len(x)):
            d_raw = d_raw_room[: rows.stop - rows.start]
            _density_backward(*(t[rows].numpy() for t in (grad, residual, share, inverse)), d_raw.numpy(), span)
            sums[0].addmm_(d_raw.t(), x[rows])
            sums[1] += d_raw.sum(0)
            below = d_raw
            for k in range(len(layers) - 1, -1, -1):
                given = inner[k - 1][rows] if k else x[rows]
                sums[2 + 2 * k].addmm_(below.t(), given)
                if k < len(layers) - 1:
                    sums[3 + 2 * k] += below.sum(0)
                if k:
                    below = below @ layers[k][0]
                    _elu_backward(below.numpy(), given.numpy())
            torch.mm(d_raw, affine, out=d_x[rows])
            if layers:
                d_x[rows].addmm_(below, layers[0][0])
        if layers:
            sums[-1] = sums[1].clone()
        return d_x, None, *sums


def _pairs(weights: Any) -> list[tuple[Tensor, Tensor]]:
    return list(zip(weights[::2], weights[1::2], strict=True))


def _rows(n: int) -> list[slice]:
    return [slice(first, min(first + ROWS, n)) for first in range(0, n, ROWS)]


@compiled(fastmath=FAST_MATH, error_model="numpy")
def _elu(values: Any, bias: Any) -> None:
    """Apply ELU to values [N, n] plus bias, in place: exp(x) - 1 = 2 t / (1 - t) with t = tanh(x / 2), which a compiler can vectorise."""
    half, one, zero = values.dtype.type(0.5), values.dtype.type(1), values.dtype.type(0)
    for i in range(values.shape[0]):
        row = values[i]
        for j in range(row.size):
            x = row[j] + bias[j]
            t = squash(half * min(x, zero))
            row[j] = max(x, zero) + (t + t) / (one - t)


@compiled(fastmath=FAST_MATH, error_model="numpy")
def _elu_backward(grad: Any, activated: Any) -> None:
    """Multiply `grad` by the slope of ELU, in place, [N, n]: 1 above zero, activation + 1 below."""
    one, zero = grad.dtype.type(1), grad.dtype.type(0)
    for i in range(grad.shape[0]):
        row, value = grad[i], activated[i]
        for j in range(row.size):
            row[j] *= one + min(value[j], zero)


@compiled(fastmath=FAST_MATH, error_model="numpy")
def _density(raw: Any, bias: Any, target: Any, residual: Any, share: Any, inverse: Any, log_prob: Any, low: float, span: float) -> None:
    """Log density of rows [N] from mean and raw log sigma [N, 2n] plus bias; residual / sigma, squashed raw and 1 / sigma are kept."""
    n = target.shape[1]
    half = raw.dtype.type(0.5)
    for i in range(raw.shape[0]):
        total = 0.0
        for k in range(n):
            inside = half + half * squash(half * (raw[i, n + k] + bias[n + k]))
            log_std = low + span * inside
            share[i, k] = inside
            inverse[i, k] = math.exp(-log_std)
            residual[i, k] = (target[i, k] - raw[i, k] - bias[k]) * inverse[i, k]
            total -= 0.5 * residual[i, k] * residual[i, k] + log_std
        log_prob[i] = total - n * _HALF_LOG_TWO_PI


@compiled(fastmath=FAST_MATH, error_model="numpy")
def _density_backward(grad: Any, residual: Any, share: Any, inverse: Any, d_raw: Any, span: float) -> None:
    """Compute gradients of mean and raw log sigma, into `d_raw` [N, 2n], from those of the log densities [N]."""
    n = residual.shape[1]
    one = residual.dtype.type(1)
    for i in range(residual.shape[0]):
        for k in range(n):
            d_raw[i, k] = grad[i] * residual[i, k] * inverse[i, k]
            slope = share[i, k] * (one - share[i, k]) * span
            d_raw[i, n + k] = grad[i] * (residual[i, k] * residual[i, k] - one) * slope
