"""DLSM speed: one gradient step against a plain loop with torch.distributions at the same sizes, and roll-outs.

CPU seconds of one thread, both sides interleaved in the same run. The plain loop computes the same loss with the same networks and
noise; its value and gradients are compared before anything is timed.

    python benchmarks/dlsm.py [--quick]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence

from ml.mdp import MdpSettings
from ml.ope.dlsm.batches import Batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.networks import DlsmNetworks, LatentRecurrence, Noise
from ml.ope.dlsm.recurrence import bounded
from ml.ope.dlsm.rollout import roll_out
from ml.ope.scale import Scale

WINDOW, BATCH, LATENT, HIDDEN = 10, 64, 16, 64
CONFIG = DlsmConfig(
    latent=LATENT,
    hidden=HIDDEN,
    heads=(128, 64),
    objective="posterior",
    state_terms="window",
    action_emission=False,
    end_features="final",
)


def random_batch(steps: int) -> Batch:
    """64 sessions of equal length with everything measured."""
    g = torch.Generator().manual_seed(0)
    ones = torch.ones(steps, BATCH)
    return Batch(
        states=torch.randn(steps + 1, BATCH, WINDOW, generator=g),
        actions=torch.rand(steps, BATCH, generator=g),
        rewards=torch.randn(steps, BATCH, generator=g),
        alive=ones,
        usable=ones,
        first_known=ones[0],
        lengths=torch.full((BATCH,), steps),
        outcomes=torch.randn(BATCH, 4, generator=g),
        outcome_mask=torch.ones(BATCH, 4),
        randomised=ones[0],
    )


def plain_cell(r: LatentRecurrence, x: Tensor, z: Tensor, h: Tensor, c: Tensor) -> tuple[Normal, Tensor, Tensor]:
    """One LSTM step and the density of the next latent."""
    g, i, f, o = (torch.cat([x, z], dim=1) @ torch.cat([r.w_x, r.w_z]) + h @ r.w_h + r.bias).chunk(4, dim=1)
    c = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
    h = torch.sigmoid(o) * torch.tanh(c)
    head, raw = (h @ r.w_out + r.b_out).chunk(2, dim=1)
    return Normal(x @ r.a_x + z @ r.a_z + head, bounded(raw).exp(), validate_args=False), h, c


def density(head: nn.Module, x: Tensor) -> Normal:
    """Density that a head gives."""
    mean, log_std = head(x)
    return Normal(mean, log_std.exp(), validate_args=False)


def plain_loss(net: DlsmNetworks, batch: Batch, noise: Noise) -> Tensor:
    """The negated bound per step as it is usually written: one loop over time, every density an object."""
    steps, sessions = batch.size
    q = density(net.first, batch.states[0])
    z = q.loc + q.scale * noise.first
    total = density(net.first_state, z).log_prob(batch.states[0]).sum()
    total = total - kl_divergence(q, Normal(torch.zeros_like(z), torch.ones_like(z))).sum()
    h_q = c_q = h_p = c_p = torch.zeros(sessions, HIDDEN)
    for t in range(steps):
        a = batch.actions[t].unsqueeze(1)
        p, h_p, c_p = plain_cell(net.decoder, a, z, h_p, c_p)
        q, h_q, c_q = plain_cell(net.encoder, torch.cat([a, batch.states[t + 1]], dim=1), z, h_q, c_q)
        z = q.loc + q.scale * noise.encoder[t]
        total = total + density(net.state, z).log_prob(batch.states[t + 1]).sum()
        total = total + density(net.reward, z).log_prob(batch.rewards[t].unsqueeze(1)).sum()
        total = total - kl_divergence(q, p).sum()
    total = total + density(net.outcome, z).log_prob(batch.outcomes).sum()
    return -total / (steps * sessions)


def gradient_step(net: DlsmNetworks, loss: Callable[[], Tensor], optimizer: torch.optim.Optimizer) -> None:
    """Forward, full back-propagation through time, clipping, Adam."""
    value = loss()
    optimizer.zero_grad(set_to_none=True)
    value.backward()
    torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
    optimizer.step()


def check_equal(net: DlsmNetworks, batch: Batch, noise: Noise) -> float:
    """Largest difference of the two gradients, relative to the largest gradient; the losses agree to 1e-4."""
    losses = [net.loss(batch, noise), plain_loss(net, batch, noise)]
    if abs(float(losses[0].detach()) - float(losses[1].detach())) > 1e-4 * abs(float(losses[1].detach())):
        raise AssertionError(f"the two losses differ: {float(losses[0].detach())} and {float(losses[1].detach())}")
    grads = [torch.autograd.grad(loss, list(net.parameters()), allow_unused=True) for loss in losses]
    pairs = [(a, b) for a, b in zip(*grads, strict=True) if a is not None and b is not None]
    top = max(float(b.abs().max()) for _, b in pairs)
    difference = max(float((a - b).abs().max()) for a, b in pairs) / top
    if difference > 1e-3:
        raise AssertionError(f"the two gradients differ by {difference:.1e} of the largest")
    return difference


def time_steps(steps: int, repeats: int) -> tuple[float, float, float]:
    """CPU seconds of a gradient step, ours and the plain loop's (medians of interleaved repeats), and the gradients' difference."""
    torch.manual_seed(0)
    net = DlsmNetworks(WINDOW, CONFIG)
    batch = random_batch(steps)
    noise = net.noise(steps, BATCH, torch.Generator().manual_seed(1))
    difference = check_equal(net, batch, noise)
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-4, foreach=True)
    ways: list[Callable[[], Tensor]] = [lambda: net.loss(batch, noise), lambda: plain_loss(net, batch, noise)]
    seconds: list[list[float]] = [[], []]
    for k in range(repeats + 1):
        for way, taken in zip(ways, seconds, strict=True):
            start = time.process_time()
            gradient_step(net, way, optimizer)
            if k:  # the first round warms up
                taken.append(time.process_time() - start)
    return float(np.median(seconds[0])), float(np.median(seconds[1])), difference


class NetworkPolicy:
    """A 400 x 300 actor with random weights."""

    def __init__(self, seed: int) -> None:
        torch.manual_seed(seed)
        self.net = nn.Sequential(nn.Linear(WINDOW, 400), nn.ReLU(), nn.Linear(400, 300), nn.ReLU(), nn.Linear(300, 1), nn.Sigmoid())

    def act(self, states: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            return self.net(torch.as_tensor(states, dtype=torch.float32)).numpy().astype(np.float64)[:, 0]


def rollout_speed(steps: int, per_policy: int, policies: int = 6) -> float:
    """Environment steps per CPU second of 400 x 300 policies in a DLSM of the same sizes."""
    torch.manual_seed(0)
    net = DlsmNetworks(WINDOW, CONFIG)
    scale = Scale(False, 1.0, 0.3, 0.1, 3.0, -0.5, 0.5, (0.0,) * 4, (1.0,) * 4, (True,) * 4)
    actors = [NetworkPolicy(k) for k in range(policies)]
    arguments = {"scale": scale, "settings": MdpSettings(xi_beta=1.0), "seed": 0}
    roll_out(net, actors, np.zeros((4, WINDOW)), horizon=5, per_policy=40, **arguments)
    start = time.process_time()
    roll_out(net, actors, np.zeros((4, WINDOW)), horizon=steps, per_policy=per_policy, **arguments)
    return steps * per_policy * policies / (time.process_time() - start)


def main() -> None:
    """Print a table and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="T = 100 and fewer repeats")
    quick = parser.parse_args().quick
    torch.set_num_threads(1)
    lengths, repeats = ((100,), 3) if quick else ((100, 300, 600), 5)
    out = sys.stdout.write
    out(f"one gradient step: batch {BATCH}, state {WINDOW}, latent {LATENT}, LSTM {HIDDEN}; CPU seconds, one thread\n")
    out(f"{'T':>5} {'ours':>8} {'plain loop':>11} {'ratio':>6} {'gradient difference':>20}\n")
    figures: dict[str, float] = {}
    ratios: dict[str, float] = {}
    for steps in lengths:
        ours, plain, difference = time_steps(steps, repeats)
        figures |= {f"step_s_t{steps}": ours, f"plain_step_s_t{steps}": plain}
        ratios[f"step_vs_plain_loop_t{steps}"] = plain / ours
        out(f"{steps:>5} {ours:>8.3f} {plain:>11.3f} {plain / ours:>6.2f} {difference:>20.1e}\n")
    ratios["step_vs_plain_loop"] = ratios[f"step_vs_plain_loop_t{100 if quick else 300}"]
    figures["rollout_steps_per_s"] = rollout_speed(100 if quick else 300, 42 if quick else 256)
    out(f"roll-outs of 6 policies 400 x 300: {figures['rollout_steps_per_s']:,.0f} environment steps per CPU second\n")
    baseline = "the same loss as a plain loop over time with torch.distributions, same sizes, same run"
    out(json.dumps({"name": "dlsm", "figures": figures, "ratios": ratios, "baseline": baseline}) + "\n")


if __name__ == "__main__":
    main()
