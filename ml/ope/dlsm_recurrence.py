"""The stochastic LSTM of eq:encoder and eq:decoder, as a readable loop and as a fused recurrence with its own backward pass.

One step, with an exogenous part that was projected for all steps beforehand:
    [g, i, f, o] = gates_t + z_{t-1} Wz + h_{t-1} Wh;   c_t = f c_{t-1} + i g;   h_t = o tanh(c_t)
    mean_t = skip_t + z_{t-1} A + h_t Wm + bm;   log sigma_t = bounded(h_t Ws + bs);   z_t = mean_t + sigma_t eps_t
where g is squashed by tanh and i, f, o by the logistic function. The skip path from z_{t-1} makes a linear-Gaussian state space a
special case and lets an effect of the action reach z_t in one step.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

LOG_STD_BOUNDS = (-4.0, 1.0)
"""Bounds of every log standard deviation, of variables that are standardised: no collapse to zero, no escape."""


def bounded(raw: Tensor) -> Tensor:
    """Log standard deviation within `LOG_STD_BOUNDS`, smooth in the raw value."""
    low, high = LOG_STD_BOUNDS
    return low + (high - low) * torch.sigmoid(raw)


def stochastic_lstm_loop(
    gates: Tensor, skip: Tensor, z0: Tensor, eps: Tensor, w_z: Tensor, w_h: Tensor, a_z: Tensor, w_out: Tensor, b_out: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The recurrence as it is written above; the slow twin of `stochastic_lstm`.

    Args:
        gates: exogenous part of the gates with their bias, [T, B, 4H], in the order g, i, f, o.
        skip: exogenous part of the mean, [T, B, Z].
        z0: first latent, [B, Z]. eps: standard normal noise, [T, B, Z].
        w_z: [Z, 4H]. w_h: [H, 4H]. a_z: [Z, Z]. w_out: [H, 2Z] for mean and raw log sigma. b_out: [2Z].

    Returns:
        z_1 ... z_T, their means and their log standard deviations, each [T, B, Z].
    """
    hidden = w_h.shape[0]
    h = torch.zeros(z0.shape[0], hidden, dtype=z0.dtype)
    c = torch.zeros_like(h)
    z = z0
    zs, means, log_stds = [], [], []
    for gate_t, skip_t, eps_t in zip(gates.unbind(0), skip.unbind(0), eps.unbind(0), strict=True):
        g, i, f, o = (gate_t + z @ w_z + h @ w_h).chunk(4, dim=1)
        c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
        h = torch.sigmoid(o) * torch.tanh(c)
        head, raw = (h @ w_out + b_out).chunk(2, dim=1)
        mean = skip_t + z @ a_z + head
        log_std = bounded(raw)
        z = mean + log_std.exp() * eps_t
        zs.append(z)
        means.append(mean)
        log_stds.append(log_std)
    return torch.stack(zs), torch.stack(means), torch.stack(log_stds)


def lstm_loop(gates: Tensor, w_h: Tensor) -> Tensor:
    """h_1 ... h_T of an LSTM whose every input is known beforehand, [T, B, H]; the slow twin of `lstm`."""
    h = torch.zeros(gates.shape[1], w_h.shape[0], dtype=gates.dtype)
    c = torch.zeros_like(h)
    hs = []
    for gate_t in gates.unbind(0):
        g, i, f, o = (gate_t + h @ w_h).chunk(4, dim=1)
        c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
        h = torch.sigmoid(o) * torch.tanh(c)
        hs.append(h)
    return torch.stack(hs)


def stochastic_lstm(
    gates: Tensor, skip: Tensor, z0: Tensor, eps: Tensor, w_z: Tensor, w_h: Tensor, a_z: Tensor, w_out: Tensor, b_out: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`stochastic_lstm_loop` at a fraction of its cost: no graph per step, one matrix product per step and direction less."""
    result: tuple[Tensor, Tensor, Tensor] = _StochasticLstm.apply(gates, skip, z0, eps, w_z, w_h, a_z, w_out, b_out)
    return result


def lstm(gates: Tensor, w_h: Tensor) -> Tensor:
    """`lstm_loop` at a fraction of its cost."""
    result: Tensor = _Lstm.apply(gates, w_h)
    return result


def _views(acts: Tensor, hidden: int) -> list[tuple[Tensor, ...]]:
    """Per step: views of g, of (i, f, o) together, of i, f and o. Made all at once: a slice costs as much as a small kernel."""
    pieces = ((0, 1), (1, 4), (1, 2), (2, 3), (3, 4))
    return list(zip(*(acts[:, :, a * hidden : b * hidden].unbind(0) for a, b in pieces), strict=True))


def _cell(gates: tuple[Tensor, ...], c_prev: Tensor, c: Tensor, tanh_c: Tensor, h: Tensor) -> None:
    """One LSTM cell in place: the gates [B, H] are squashed; c, tanh c and h are written."""
    g, squashed, i, f, o = gates
    g.tanh_()
    squashed.sigmoid_()
    torch.mul(g, i, out=c)
    c.addcmul_(f, c_prev)
    torch.tanh(c, out=tanh_c)
    torch.mul(o, tanh_c, out=h)


def _cell_backward(slope: tuple[Tensor, ...], out: tuple[Tensor, ...], d_h: Tensor, d_c: Tensor) -> None:
    """Gradients of the gates before squashing, written to `out`, from those of h and c."""
    torch.mul(slope[0], d_c, out=out[0])
    torch.mul(slope[1], d_h, out=out[1])


def _backward_views(tensor: Tensor, hidden: int) -> list[tuple[Tensor, ...]]:
    """Per step: views of (g, i, f) as [3, B, H], so that one [B, H] factor broadcasts, and of o."""
    first = tensor[:, :, : 3 * hidden].unflatten(2, (3, hidden)).transpose(1, 2)
    return list(zip(first.unbind(0), tensor[:, :, 3 * hidden : 4 * hidden].unbind(0), strict=True))


def _gate_slopes(acts: Tensor, c: Tensor, tanh_c: Tensor) -> tuple[Tensor, Tensor]:
    """For all steps at once: d(gate)/d(c_t) for g, i, f and d(gate o)/d(h_t), [T, B, 4H], and d(c_t)/d(h_t), [T, B, H]."""
    hidden = c.shape[2]
    g, i, _, o = acts.split(hidden, dim=2)
    slopes = torch.empty_like(acts)
    s_g, s_i, s_f, s_o = slopes.split(hidden, dim=2)
    torch.mul(g, g, out=s_g).neg_().add_(1.0).mul_(i)
    gates = slopes[:, :, hidden:]
    torch.mul(acts[:, :, hidden:], acts[:, :, hidden:], out=gates).neg_().add_(acts[:, :, hidden:])
    s_i.mul_(g)
    s_f[1:].mul_(c[:-1])
    s_f[0].zero_()
    s_o.mul_(tanh_c)
    to_c = torch.mul(tanh_c, tanh_c).neg_().add_(1.0).mul_(o)
    return slopes, to_c


class _StochasticLstm(torch.autograd.Function):
    """`stochastic_lstm_loop` with hand-written derivatives: loops hold only what is sequential, weight gradients are one product."""

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        gates, skip, z0, eps, w_z, w_h, a_z, w_out, b_out = inputs
        steps, batch, latent = eps.shape
        hidden = w_h.shape[0]
        low, high = LOG_STD_BOUNDS
        # One product serves gates and skip path: [z, h] @ [[w_z, a_z], [w_h, 0]].
        joint = torch.cat([torch.cat([w_z, a_z], dim=1), torch.nn.functional.pad(w_h, (0, latent))], dim=0)
        carry = eps.new_zeros(steps + 1, batch, latent + hidden)
        carry[0, :, :latent] = z0
        acts = torch.cat([gates, skip], dim=2)
        c, tanh_c = eps.new_empty(steps, batch, hidden), eps.new_empty(steps, batch, hidden)
        heads = eps.new_empty(steps, batch, 2 * latent)
        std = eps.new_empty(steps, batch, latent)
        c_prev = eps.new_zeros(batch, hidden)
        rows = zip(
            acts.unbind(0),
            _views(acts, hidden),
            acts[:, :, 4 * hidden :].unbind(0),
            carry[:-1].unbind(0),
            carry[1:, :, :latent].unbind(0),
            carry[1:, :, latent:].unbind(0),
            c.unbind(0),
            tanh_c.unbind(0),
            heads.unbind(0),
            heads[:, :, :latent].unbind(0),
            heads[:, :, latent:].unbind(0),
            std.unbind(0),
            eps.unbind(0),
            strict=True,
        )
        for act, gate_views, skip_t, now, z, h, c_t, tanh_t, head, mean, raw, std_t, eps_t in rows:
            act.addmm_(now, joint)
            _cell(gate_views, c_prev, c_t, tanh_t, h)
            torch.addmm(b_out, h, w_out, out=head)
            mean.add_(skip_t)
            raw.sigmoid_()
            torch.mul(raw, high - low, out=std_t).add_(low).exp_()
            torch.addcmul(mean, std_t, eps_t, out=z)
            c_prev = c_t
        ctx.save_for_backward(carry, acts, c, tanh_c, heads, std, eps, joint, w_out)
        ctx.sizes = (latent, hidden)
        mean_out = heads[:, :, :latent].clone()
        log_std = heads[:, :, latent:] * (high - low) + low
        return carry[1:, :, :latent].clone(), mean_out, log_std

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        carry, acts, c, tanh_c, heads, std, eps, joint, w_out = ctx.saved_tensors
        latent, hidden = ctx.sizes
        grad_z, grad_mean, grad_log_std = grads
        low, high = LOG_STD_BOUNDS
        batch = eps.shape[1]
        squashed = heads[:, :, latent:]
        bound_slope = (squashed - squashed * squashed) * (high - low)
        noise_slope = std * eps * bound_slope
        d_head = torch.cat([grad_mean + grad_z, torch.addcmul(grad_log_std * bound_slope, grad_z, noise_slope)], dim=2)
        slopes, to_c = _gate_slopes(acts[:, :, : 4 * hidden], c, tanh_c)
        d_acts = torch.empty_like(acts)
        joint_t, out_t = joint.t().contiguous(), w_out.t().contiguous()
        d_carry = eps.new_zeros(batch, latent + hidden)
        d_z, d_h_next = d_carry[:, :latent], d_carry[:, latent:]
        d_c = eps.new_zeros(batch, hidden)
        d_h = eps.new_empty(batch, hidden)
        rows = zip(
            d_head.unbind(0),
            d_head[:, :, :latent].unbind(0),
            d_head[:, :, latent:].unbind(0),
            noise_slope.unbind(0),
            d_acts.unbind(0),
            _backward_views(d_acts, hidden),
            d_acts[:, :, 4 * hidden :].unbind(0),
            _backward_views(slopes, hidden),
            to_c.unbind(0),
            acts[:, :, 2 * hidden : 3 * hidden].unbind(0),
            strict=True,
        )
        for head, d_mean, d_raw, noise, act, gates, skip, slope, to_c_t, forget in reversed(list(rows)):
            d_mean.add_(d_z)
            d_raw.addcmul_(d_z, noise)
            torch.addmm(d_h_next, head, out_t, out=d_h)
            d_c.addcmul_(d_h, to_c_t)
            _cell_backward(slope, gates, d_h, d_c)
            skip.copy_(d_mean)
            torch.mm(act, joint_t, out=d_carry)
            d_c.mul_(forget)
        flat_acts, flat_head = d_acts.reshape(-1, 4 * hidden + latent), d_head.reshape(-1, 2 * latent)
        d_joint = carry[:-1].reshape(-1, latent + hidden).t() @ flat_acts
        d_out = carry[1:, :, latent:].reshape(-1, hidden).t() @ flat_head
        return (
            d_acts[:, :, : 4 * hidden],
            d_acts[:, :, 4 * hidden :],
            d_carry[:, :latent].clone(),
            None,
            d_joint[:latent, : 4 * hidden],
            d_joint[latent:, : 4 * hidden],
            d_joint[:latent, 4 * hidden :],
            d_out,
            flat_head.sum(0),
        )


class _Lstm(torch.autograd.Function):
    """`lstm_loop` with hand-written derivatives."""

    @staticmethod
    def forward(ctx: Any, gates: Tensor, w_h: Tensor) -> Tensor:
        steps, batch, _ = gates.shape
        hidden = w_h.shape[0]
        acts = gates.clone()
        hs = gates.new_zeros(steps + 1, batch, hidden)
        c, tanh_c = gates.new_empty(steps, batch, hidden), gates.new_empty(steps, batch, hidden)
        c_prev = gates.new_zeros(batch, hidden)
        rows = zip(acts.unbind(0), _views(acts, hidden), hs[:-1].unbind(0), hs[1:].unbind(0), c.unbind(0), tanh_c.unbind(0), strict=True)
        for act, gate_views, before, after, c_t, tanh_t in rows:
            act.addmm_(before, w_h)
            _cell(gate_views, c_prev, c_t, tanh_t, after)
            c_prev = c_t
        ctx.save_for_backward(acts, hs, c, tanh_c, w_h)
        return hs[1:].clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        acts, hs, c, tanh_c, w_h = ctx.saved_tensors
        (grad_h,) = grads
        _, batch, hidden = c.shape
        slopes, to_c = _gate_slopes(acts, c, tanh_c)
        d_acts = torch.empty_like(acts)
        back = w_h.t().contiguous()
        d_c = c.new_zeros(batch, hidden)
        d_h = grad_h.new_zeros(batch, hidden)
        rows = zip(
            grad_h.unbind(0),
            d_acts.unbind(0),
            _backward_views(d_acts, hidden),
            _backward_views(slopes, hidden),
            to_c.unbind(0),
            acts[:, :, 2 * hidden : 3 * hidden].unbind(0),
            strict=True,
        )
        for grad, act, gates, slope, to_c_t, forget in reversed(list(rows)):
            d_h.add_(grad)
            d_c.addcmul_(d_h, to_c_t)
            _cell_backward(slope, gates, d_h, d_c)
            torch.mm(act, back, out=d_h)
            d_c.mul_(forget)
        return d_acts, hs[:-1].reshape(-1, hidden).t() @ d_acts.reshape(-1, 4 * hidden)
