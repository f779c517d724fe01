"""The stochastic LSTM of eq:encoder and eq:decoder, as a readable loop and as a fused recurrence with its own backward pass.

One step, with exogenous input x_t:
    [g, i, f, o] = x_t Wx + b + z_{t-1} Wz + h_{t-1} Wh;   c_t = f c_{t-1} + i g;   h_t = o tanh(c_t)
    mean_t = x_t Ax + z_{t-1} A + h_t Wm + bm;   log sigma_t = bounded(h_t Ws + bs);   z_t = mean_t + sigma_t eps_t
where g is squashed by tanh and i, f, o by the logistic function. The skip path from z_{t-1} makes a linear-Gaussian state space a
special case and lets an effect of the action reach z_t in one step.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ml.ope.lstm_kernels import cell_backward, cell_forward, latent_backward, latent_forward

LOG_STD_BOUNDS = (-4.0, 1.0)
"""Bounds of every log standard deviation, of variables that are standardised: no collapse to zero, no escape."""


def bounded(raw: Tensor) -> Tensor:
    """Log standard deviation within `LOG_STD_BOUNDS`, smooth in the raw value."""
    low, high = LOG_STD_BOUNDS
    return low + (high - low) * torch.sigmoid(raw)


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
    """The recurrence as it is written above; the slow twin of `stochastic_lstm`.

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
    """h_1 ... h_T of an LSTM whose every input is known beforehand, [T, B, H]; the slow twin of `lstm`.

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
    """`stochastic_lstm_loop` at a fraction of its cost: no graph per step, elementwise work compiled, one product less per direction."""
    result: tuple[Tensor, Tensor, Tensor] = _StochasticLstm.apply(x, z0, eps, *weights)
    return result


def lstm(x: Tensor, w_x: Tensor, bias: Tensor, w_h: Tensor) -> Tensor:
    """`lstm_loop` at a fraction of its cost."""
    result: Tensor = _Lstm.apply(x, w_x, bias, w_h)
    return result


def _project(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """x W + b of all steps in one product; a fresh [T, B, n] that may be overwritten."""
    return torch.addmm(bias, x.reshape(-1, x.shape[2]), weight).view(x.shape[0], x.shape[1], -1)


def _starting_at_zero(steps: int, batch: int, width: int, like: Tensor) -> Tensor:
    """Room for a state at times 0 ... T, [T + 1, B, n], of which only time 0 is filled, with zeros."""
    states = like.new_empty(steps + 1, batch, width)
    states[0].zero_()
    return states


class _StochasticLstm(torch.autograd.Function):
    """`stochastic_lstm_loop` with hand-written derivatives: loops hold only what is sequential, weight gradients are one product."""

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, z0, eps = inputs[:3]
        w_x, bias, a_x, w_z, w_h, a_z, w_out, b_out = inputs[3:]
        steps, batch, latent = eps.shape
        hidden = w_h.shape[0]
        low, high = LOG_STD_BOUNDS
        # One product serves gates and skip path: [z, h] @ [[w_z, a_z], [w_h, 0]].
        joint = torch.cat([torch.cat([w_z, a_z], dim=1), torch.nn.functional.pad(w_h, (0, latent))], dim=0)
        carry = _starting_at_zero(steps, batch, latent + hidden, like=eps)
        carry[0, :, :latent] = z0
        w_in = torch.cat([w_x, a_x], dim=1)
        acts = _project(x, w_in, torch.nn.functional.pad(bias, (0, latent)))
        c, tanh_c = _starting_at_zero(steps, batch, hidden, like=eps), eps.new_empty(steps, batch, hidden)
        heads, std = eps.new_empty(steps, batch, 2 * latent), eps.new_empty(steps, batch, latent)
        arrays = acts.numpy(), c.numpy(), tanh_c.numpy(), carry.numpy()
        latents = heads.numpy(), arrays[0], eps.contiguous().numpy(), std.numpy(), arrays[3]
        rows = zip(acts.unbind(0), carry[:-1].unbind(0), carry[1:, :, latent:].unbind(0), heads.unbind(0), strict=True)
        for t, (act, now, h, head) in enumerate(rows):
            act.addmm_(now, joint)
            cell_forward(t, *arrays, latent)
            torch.addmm(b_out, h, w_out, out=head)
            latent_forward(t, *latents, low, high)
        ctx.save_for_backward(x, carry, acts, c, tanh_c, heads, std, eps, w_in, joint, w_out)
        ctx.sizes = (latent, hidden)
        return carry[1:, :, :latent].clone(), heads[:, :, :latent].clone(), heads[:, :, latent:] * (high - low) + low

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, carry, acts, c, tanh_c, heads, std, eps, w_in, joint, w_out = ctx.saved_tensors
        latent, hidden = ctx.sizes
        low, high = LOG_STD_BOUNDS
        batch = eps.shape[1]
        d_head, d_acts = torch.empty_like(heads), torch.empty_like(acts)
        joint_t, out_t = joint.t().contiguous(), w_out.t().contiguous()
        d_carry = eps.new_zeros(batch, latent + hidden)
        d_h_next = d_carry[:, latent:]
        d_c, d_h = eps.new_zeros(batch, hidden), eps.new_empty(batch, hidden)
        from_above = [g.contiguous().numpy() for g in grads]
        latents = *from_above, heads.numpy(), std.numpy(), eps.contiguous().numpy(), d_carry.numpy(), d_head.numpy(), d_acts.numpy()
        cells = d_h.numpy(), acts.numpy(), c.numpy(), tanh_c.numpy(), d_c.numpy(), d_acts.numpy()
        for t, (head, act) in reversed(list(enumerate(zip(d_head.unbind(0), d_acts.unbind(0), strict=True)))):
            latent_backward(t, *latents, high - low)
            torch.addmm(d_h_next, head, out_t, out=d_h)
            cell_backward(t, *cells)
            torch.mm(act, joint_t, out=d_carry)
        flat_acts, flat_head = d_acts.reshape(-1, 4 * hidden + latent), d_head.reshape(-1, 2 * latent)
        d_joint = carry[:-1].reshape(-1, latent + hidden).t() @ flat_acts
        d_out = carry[1:, :, latent:].reshape(-1, hidden).t() @ flat_head
        d_in = x.reshape(-1, x.shape[2]).t() @ flat_acts
        d_x = (flat_acts @ w_in.t()).view(x.shape) if ctx.needs_input_grad[0] else None
        gates = slice(0, 4 * hidden), slice(4 * hidden, None)
        return (
            d_x,
            d_carry[:, :latent].clone(),
            None,
            d_in[:, gates[0]],
            flat_acts[:, gates[0]].sum(0),
            d_in[:, gates[1]],
            d_joint[:latent, gates[0]],
            d_joint[latent:, gates[0]],
            d_joint[:latent, gates[1]],
            d_out,
            flat_head.sum(0),
        )


class _Lstm(torch.autograd.Function):
    """`lstm_loop` with hand-written derivatives."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, w_x: Tensor, bias: Tensor, w_h: Tensor) -> Tensor:
        steps, batch, _ = x.shape
        hidden = w_h.shape[0]
        acts = _project(x, w_x, bias)
        hs, c = _starting_at_zero(steps, batch, hidden, like=x), _starting_at_zero(steps, batch, hidden, like=x)
        tanh_c = x.new_empty(steps, batch, hidden)
        arrays = acts.numpy(), c.numpy(), tanh_c.numpy(), hs.numpy()
        for t, (act, before) in enumerate(zip(acts.unbind(0), hs[:-1].unbind(0), strict=True)):
            act.addmm_(before, w_h)
            cell_forward(t, *arrays, 0)
        ctx.save_for_backward(x, acts, hs, c, tanh_c, w_x, w_h)
        return hs[1:].clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, acts, hs, c, tanh_c, w_x, w_h = ctx.saved_tensors
        _, batch, hidden = tanh_c.shape
        d_acts = torch.empty_like(acts)
        back = w_h.t().contiguous()
        d_c, d_h = c.new_zeros(batch, hidden), c.new_zeros(batch, hidden)
        cells = d_h.numpy(), acts.numpy(), c.numpy(), tanh_c.numpy(), d_c.numpy(), d_acts.numpy()
        rows = zip(grads[0].unbind(0), d_acts.unbind(0), strict=True)
        for t, (grad, act) in reversed(list(enumerate(rows))):
            d_h.add_(grad)
            cell_backward(t, *cells)
            torch.mm(act, back, out=d_h)
        flat = d_acts.view(-1, 4 * hidden)
        d_x = (flat @ w_x.t()).view(x.shape) if ctx.needs_input_grad[0] else None
        return d_x, x.reshape(-1, x.shape[2]).t() @ flat, flat.sum(0), hs[:-1].reshape(-1, hidden).t() @ flat
