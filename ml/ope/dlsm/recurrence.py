"""The stochastic LSTM of eq:encoder and eq:decoder, as a readable loop and as a fused recurrence with its own backward pass.

One step, with exogenous input x_t:
    [g, i, f, o] = x_t Wx + b + z_{t-1} Wz + h_{t-1} Wh;   c_t = f c_{t-1} + i g;   h_t = o tanh(c_t)
    mean_t = x_t Ax + z_{t-1} A + h_t Wm + bm;   log sigma_t = bounded(h_t Ws + bs);   z_t = mean_t + sigma_t eps_t
where g is squashed by tanh and i, f, o by the logistic function. The skip path from z_{t-1} makes a linear-Gaussian state space a
special case and lets an effect of the action reach z_t in one step.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from ml.ope.dlsm.kernels import lstm_backward, lstm_forward, stochastic_backward, stochastic_forward

LOG_STD_BOUNDS = (-4.0, 1.0)
"""Bounds of every log standard deviation, of variables that are standardised: no collapse to zero, no escape."""


def bounded(raw: Tensor) -> Tensor:
    """Log standard deviation within `LOG_STD_BOUNDS`, smooth in the raw value."""
    low, high = LOG_STD_BOUNDS
    return low + (high - low) * torch.sigmoid(raw)


def unbounded(log_std: float) -> float:
    """Invert the bounds of a log standard deviation, which is taken to be within a hundredth of the bounds' width inside them."""
    low, high = LOG_STD_BOUNDS
    share = min(max((log_std - low) / (high - low), 0.01), 0.99)
    return math.log(share / (1 - share))


class LatentWeights(NamedTuple):
    """Weights of the stochastic LSTM: gates in the order g, i, f, o.

    Attributes:
        w_x: [X, 4H]. bias: [4H]. a_x: [X, Z]. w_z: [Z, 4H]. w_h: [H, 4H]. a_z: [Z, Z].
        w_out: [H, 2Z] for mean and raw log sigma. b_out: [2Z].
    """

    w_x: Tensor
    bias: Tensor
    a_x: Tensor
    w_z: Tensor
    w_h: Tensor
    a_z: Tensor
    w_out: Tensor
    b_out: Tensor


def stochastic_lstm_loop(x: Tensor, z0: Tensor, eps: Tensor, weights: LatentWeights) -> tuple[Tensor, Tensor, Tensor]:
    """Run the recurrence as it is written above; the slow twin of `stochastic_lstm`.

    Args:
        x: exogenous input, [T, B, X]. z0: first latent, [B, Z]. eps: standard normal noise, [T, B, Z].
        weights: see there.

    Returns:
        z_1 ... z_T, their means and their log standard deviations, each [T, B, Z].
    """
    w = weights
    h = torch.zeros(z0.shape[0], w.w_h.shape[0], dtype=z0.dtype)
    c = torch.zeros_like(h)
    z = z0
    zs, means, log_stds = [], [], []
    gates, skip = x @ w.w_x + w.bias, x @ w.a_x
    for gate_t, skip_t, eps_t in zip(gates.unbind(0), skip.unbind(0), eps.unbind(0), strict=True):
        g, i, f, o = (gate_t + z @ w.w_z + h @ w.w_h).chunk(4, dim=1)
        c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
        h = torch.sigmoid(o) * torch.tanh(c)
        head, raw = (h @ w.w_out + w.b_out).chunk(2, dim=1)
        mean = skip_t + z @ w.a_z + head
        log_std = bounded(raw)
        z = mean + log_std.exp() * eps_t
        zs.append(z)
        means.append(mean)
        log_stds.append(log_std)
    return torch.stack(zs), torch.stack(means), torch.stack(log_stds)


def lstm_loop(x: Tensor, w_x: Tensor, bias: Tensor, w_h: Tensor) -> Tensor:
    """Compute h_1 ... h_T of an LSTM whose every input is known beforehand, [T, B, H]; the slow twin of `lstm`.

    Args:
        x: [T, B, X]. w_x: [X, 4H]. bias: [4H]. w_h: [H, 4H].
    """
    h = torch.zeros(x.shape[1], w_h.shape[0], dtype=x.dtype)
    c = torch.zeros_like(h)
    hs = []
    for gate_t in (x @ w_x + bias).unbind(0):
        g, i, f, o = (gate_t + h @ w_h).chunk(4, dim=1)
        c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
        h = torch.sigmoid(o) * torch.tanh(c)
        hs.append(h)
    return torch.stack(hs)


def stochastic_lstm(x: Tensor, z0: Tensor, eps: Tensor, weights: LatentWeights) -> tuple[Tensor, Tensor, Tensor]:
    """Run `stochastic_lstm_loop` at a fraction of its cost: no graph per step, the loop compiled, one product less per direction."""
    result: tuple[Tensor, Tensor, Tensor] = _StochasticLstm.apply(x, z0, eps, *weights)
    return result


def lstm(x: Tensor, w_x: Tensor, bias: Tensor, w_h: Tensor) -> Tensor:
    """Run `lstm_loop` at a fraction of its cost."""
    result: Tensor = _Lstm.apply(x, w_x, bias, w_h)
    return result


CHUNK = 1 << 18
"""Numbers per piece of a [T, B, n] array that is processed at once. A piece is still in the cache when it is read again."""


def _pieces(steps: int, per_step: int) -> list[slice]:
    """Split steps into pieces of about `CHUNK` numbers."""
    length = max(1, CHUNK // per_step)
    return [slice(first, min(first + length, steps)) for first in range(0, steps, length)]


def _starting_at_zero(steps: int, batch: int, width: int, like: Tensor) -> Tensor:
    """Make memory for a state at times 0 ... T, [T + 1, B, n], of which only time 0 is filled, with zeros."""
    states = like.new_empty(steps + 1, batch, width)
    states[0].zero_()
    return states


def _arrays(*tensors: Tensor) -> list[NDArray[Any]]:
    """Convert tensors to arrays of the same memory, as the compiled loops take it."""
    return [t.detach().numpy() for t in tensors]


def _states(t: slice) -> slice:
    """Select the states before and after the steps of a piece."""
    return slice(t.start, t.stop + 1)


def _flat(values: Tensor) -> Tensor:
    """Flatten [T, B, n] to [T B, n]."""
    return values.reshape(-1, values.shape[2])


class _StochasticLstm(torch.autograd.Function):
    """`stochastic_lstm_loop` with hand-written derivatives: loops hold only what is sequential, weight gradients are large products."""

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, z0, eps = inputs[0].contiguous(), inputs[1], inputs[2].contiguous()
        w_x, bias, a_x, w_z, w_h, a_z, w_out, b_out = inputs[3:]
        steps, batch, latent = eps.shape
        hidden = w_h.shape[0]
        width = 4 * hidden + latent
        low, high = LOG_STD_BOUNDS
        # One product serves gates and skip path: [z, h] @ [[w_z, a_z], [w_h, 0]].
        joint = torch.cat([torch.cat([w_z, a_z], dim=1), pad(w_h, (0, latent))], dim=0)
        w_in = torch.cat([w_x, a_x], dim=1)
        carry = _starting_at_zero(steps, batch, latent + hidden, like=eps)
        carry[0, :, :latent] = z0
        acts = eps.new_empty(steps, batch, width)
        c, tanh_c = _starting_at_zero(steps, batch, hidden, like=eps), eps.new_empty(steps, batch, hidden)
        z, mean, log_std, share, std = (torch.empty_like(eps) for _ in range(5))
        weights = _arrays(joint, pad(bias, (0, latent)), w_out.contiguous(), b_out)
        for t in _pieces(steps, batch * width):
            torch.mm(_flat(x[t]), w_in, out=_flat(acts[t]))
            states = _arrays(acts[t], carry[_states(t)], c[_states(t)], tanh_c[t], eps[t], z[t], mean[t], log_std[t], share[t], std[t])
            stochastic_forward(*states, *weights, low, high - low)
        ctx.save_for_backward(x, carry, acts, c, tanh_c, eps, share, std, w_in, joint, w_out)
        return z, mean, log_std

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, carry, acts, c, tanh_c, eps, share, std, w_in, joint, w_out = ctx.saved_tensors
        (steps, batch, latent), hidden, width = eps.shape, tanh_c.shape[2], acts.shape[2]
        pieces = _pieces(steps, batch * width)
        low, high = LOG_STD_BOUNDS
        buffers = eps.new_empty(pieces[0].stop, batch, width), eps.new_empty(pieces[0].stop, batch, 2 * latent)
        d_carry, d_c = torch.zeros_like(carry[0]), torch.zeros_like(c[0])
        d_in, d_joint, d_out = torch.zeros_like(w_in), torch.zeros_like(joint), eps.new_zeros(latent + hidden, 2 * latent)
        d_bias, d_b_out = eps.new_zeros(width), eps.new_zeros(2 * latent)
        d_x = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        above = [g.contiguous() for g in grads]
        transposed = _arrays(joint.t().contiguous(), w_out.t().contiguous())
        for t in reversed(pieces):
            d_acts, d_heads = (r[: t.stop - t.start] for r in buffers)
            given = _arrays(*(g[t] for g in above), acts[t], c[_states(t)], tanh_c[t], eps[t], share[t], std[t])
            stochastic_backward(*given, *transposed, *_arrays(d_acts, d_heads, d_carry, d_c), high - low)
            flat, flat_heads, states = _flat(d_acts), _flat(d_heads), carry[_states(t)]
            d_joint.addmm_(_flat(states[:-1]).t(), flat)
            d_out.addmm_(_flat(states[1:]).t(), flat_heads)
            d_in.addmm_(_flat(x[t]).t(), flat)
            d_bias += flat.sum(0)
            d_b_out += flat_heads.sum(0)
            if d_x is not None:
                torch.mm(flat, w_in.t(), out=_flat(d_x[t]))
        gates, skip = slice(0, 4 * hidden), slice(4 * hidden, None)
        return (
            d_x,
            d_carry[:, :latent],
            None,
            d_in[:, gates],
            d_bias[gates],
            d_in[:, skip],
            d_joint[:latent, gates],
            d_joint[latent:, gates],
            d_joint[:latent, skip],
            d_out[latent:],
            d_b_out,
        )


class _Lstm(torch.autograd.Function):
    """`lstm_loop` with hand-written derivatives."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, w_x: Tensor, bias: Tensor, w_h: Tensor) -> Tensor:
        x = x.contiguous()
        steps, batch, _ = x.shape
        hidden = w_h.shape[0]
        acts = x.new_empty(steps, batch, 4 * hidden)
        hs, c = _starting_at_zero(steps, batch, hidden, like=x), _starting_at_zero(steps, batch, hidden, like=x)
        tanh_c = x.new_empty(steps, batch, hidden)
        weights = _arrays(w_h.contiguous(), bias)
        for t in _pieces(steps, batch * 4 * hidden):
            torch.mm(_flat(x[t]), w_x, out=_flat(acts[t]))
            lstm_forward(*_arrays(acts[t], hs[_states(t)], c[_states(t)], tanh_c[t]), *weights)
        ctx.save_for_backward(x, acts, hs, c, tanh_c, w_x, w_h)
        return hs[1:]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, acts, hs, c, tanh_c, w_x, w_h = ctx.saved_tensors
        (steps, batch, hidden), above = tanh_c.shape, grads[0].contiguous()
        pieces = _pieces(steps, batch * 4 * hidden)
        buffer = acts.new_empty(pieces[0].stop, batch, 4 * hidden)
        d_h, d_c = torch.zeros_like(c[0]), torch.zeros_like(c[0])
        d_in, d_bias, d_w_h = torch.zeros_like(w_x), acts.new_zeros(4 * hidden), torch.zeros_like(w_h)
        d_x = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        (back,) = _arrays(w_h.t().contiguous())
        for t in reversed(pieces):
            d_acts = buffer[: t.stop - t.start]
            lstm_backward(*_arrays(above[t], acts[t], c[_states(t)], tanh_c[t]), back, *_arrays(d_acts, d_h, d_c))
            flat = _flat(d_acts)
            d_w_h.addmm_(_flat(hs[t]).t(), flat)
            d_in.addmm_(_flat(x[t]).t(), flat)
            d_bias += flat.sum(0)
            if d_x is not None:
                torch.mm(flat, w_x.t(), out=_flat(d_x[t]))
        return d_x, d_in, d_bias, d_w_h
