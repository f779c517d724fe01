"""Networks that correct differences to cDBS (`ml.ope.posterior.learned.networks`), trained on worlds whose truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ml.ope.posterior.learned.networks import CUT, LEAST_ERROR, LOG_SD, NEAR_CDBS, Networks, Q

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Example:
    """Policies of one record of one world, cDBS last.

    Attributes:
        parts: numbers by name, [P] each. base: differences before correction, [P, 4]. truth: true differences, [P, 4].
        returns: weights of the four in the return, [4].
        world: name of the world, by which folds are made.
    """

    parts: Mapping[str, Floats]
    base: Floats
    truth: Floats
    returns: Floats
    world: str


@dataclass(frozen=True, kw_only=True)
class Training:
    """How networks are trained.

    Attributes:
        members: networks. hidden: units of a layer. epochs: over the examples. rate, decay: of AdamW. dropout: share of units.
        order: weight of the order of returns within a world beside the likelihood. batch: examples per step.
    """

    members: int
    hidden: int = 24
    epochs: int = 80
    rate: float = 3e-3
    decay: float = 1e-2
    dropout: float = 0.1
    order: float = 0.5
    batch: int = 32


class _Net(torch.nn.Module):
    def __init__(self, inputs: int, hidden: int, dropout: float) -> None:
        super().__init__()
        self.layers = torch.nn.ModuleList(
            [torch.nn.Linear(inputs, hidden), torch.nn.Linear(hidden, hidden), torch.nn.Linear(hidden, 2 * Q)]
        )
        torch.nn.init.zeros_(self.layers[-1].weight)
        torch.nn.init.zeros_(self.layers[-1].bias)
        self.dropout = torch.nn.Dropout(dropout)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        for layer in self.layers[:-1]:
            x = self.dropout(torch.tanh(layer(x)))
        result: torch.Tensor = self.layers[-1](x)
        return result


def train(examples: Sequence[Example], training: Training, seed: int = 0) -> Networks:
    """An ensemble that differs in its beginnings and in the order of examples.

    Raises:
        ValueError: no example.
    """
    if not examples:
        raise ValueError("there is no example to learn from")
    names = tuple(examples[0].parts)
    rows = np.concatenate([np.stack([e.parts[n] for n in names], 1)[:-1] for e in examples])
    wrong = np.concatenate([(e.truth - e.base)[:-1] for e in examples])
    centre, spread, scale = rows.mean(0), rows.std(0) + 1e-6, wrong.std(0) + 1e-9
    batch = _Padded.of(examples, names, centre, spread)
    members = [_member(batch, training, scale, seed + k) for k in range(training.members)]
    layers = tuple((np.stack([m[k][0] for m in members]), np.stack([m[k][1] for m in members])) for k in range(3))
    found = Networks(names, centre, spread, scale, layers, 1.0)
    usual = float(np.quantile(np.concatenate([found.outside(e.parts)[:-1] for e in examples]), 0.995))
    return Networks(names, centre, spread, scale, layers, max(usual, 1e-3))


@dataclass(frozen=True)
class _Padded:
    """Examples side by side, [N, P, ...]: numbers, base, truth, distance to cDBS, which rows count; weights of the return [N, 4]."""

    x: torch.Tensor
    base: torch.Tensor
    truth: torch.Tensor
    distance: torch.Tensor
    counts: torch.Tensor
    returns: torch.Tensor

    @classmethod
    def of(cls, examples: Sequence[Example], names: Sequence[str], centre: Floats, spread: Floats) -> _Padded:
        most = max(len(e.base) for e in examples)

        def padded(values: Sequence[Floats]) -> torch.Tensor:
            return torch.tensor(
                np.stack([np.pad(v, ((0, most - len(v)),) + ((0, 0),) * (v.ndim - 1)) for v in values]), dtype=torch.float32
            )

        numbers = [np.clip((np.stack([e.parts[n] for n in names], 1) - centre) / spread, -CUT, CUT) for e in examples]
        distance = [np.tanh(np.sqrt(e.parts["dose"] ** 2 + e.parts["moving"] ** 2) / NEAR_CDBS) for e in examples]
        counts = [np.append(np.ones(len(e.base) - 1), 0.0) for e in examples]
        return cls(
            padded(numbers),
            padded([e.base for e in examples]),
            padded([e.truth for e in examples]),
            padded(distance),
            padded(counts),
            torch.tensor(np.stack([e.returns for e in examples]), dtype=torch.float32),
        )


def _member(batch: _Padded, training: Training, scale: Floats, seed: int) -> list[tuple[Floats, Floats]]:
    torch.manual_seed(seed)
    rng, n = np.random.default_rng(seed), len(batch.x)
    net = _Net(batch.x.shape[-1], training.hidden, training.dropout)
    optimizer = torch.optim.AdamW(net.parameters(), lr=training.rate, weight_decay=training.decay)
    per_epoch = max(1, n // training.batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, training.rate, total_steps=training.epochs * per_epoch)
    sizes = torch.tensor(scale, dtype=torch.float32)
    for _ in range(training.epochs):
        order = rng.permutation(n)
        for k in range(per_epoch):
            loss = _loss(net, batch, torch.as_tensor(order[k * training.batch : (k + 1) * training.batch]), sizes, training.order)
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
            optimizer.step()
            schedule.step()
    found = []
    for layer in net.layers:
        weight, bias = (p.detach().numpy().astype(np.float64) for p in (layer.weight, layer.bias))
        found.append((weight.T, bias))
    return found


def _loss(net: _Net, batch: _Padded, rows: torch.Tensor, scale: torch.Tensor, order: float) -> torch.Tensor:
    """Negative log likelihood of Student's t with four degrees of freedom, and how far the order of returns is missed."""
    out, near = net(batch.x[rows]), batch.distance[rows][..., None]
    said = batch.base[rows] + near * scale * out[..., :Q]
    sd = scale * torch.exp(out[..., Q:].clamp(*LOG_SD)) * (near + LEAST_ERROR)
    truth, counts = batch.truth[rows], batch.counts[rows]
    likelihood = 2.5 * torch.log1p(((truth - said) / sd) ** 2 / 4) + torch.log(sd / scale)
    loss = (likelihood.mean(-1) * counts).sum() / counts.sum()
    weights = batch.returns[rows][:, None]
    for own in (weights, torch.cat([weights[..., :1], torch.zeros_like(weights[..., 1:])], -1)):
        ours, theirs = ((v * own).sum(-1) for v in (said, truth))
        ours, theirs = ((v - (v * counts).sum(1, keepdim=True) / counts.sum(1, keepdim=True)) * counts for v in (ours, theirs))
        correlation = (ours * theirs).sum(1) / torch.sqrt((ours**2).sum(1) * (theirs**2).sum(1) + 1e-6)
        loss = loss + order / 2 * (1 - correlation).mean()
    return loss


def folds(examples: Sequence[Example], number: int) -> list[NDArray[np.int64]]:
    """Indices of every fold; examples of one world stay together."""
    worlds = {name: k % number for k, name in enumerate(sorted({e.world for e in examples}))}
    own = np.array([worlds[e.world] for e in examples])
    return [np.flatnonzero(own == k) for k in range(number)]


def plain(networks: Networks) -> dict[str, Any]:
    """What is stored of networks."""
    found: dict[str, Any] = {"names": np.array(networks.names), "usual": np.float32(networks.usual)}
    found |= {name: np.asarray(getattr(networks, name), dtype=np.float32) for name in ("centre", "spread", "scale")}
    for k, (weights, offsets) in enumerate(networks.layers):
        found |= {f"weights_{k}": weights.astype(np.float32), f"offsets_{k}": offsets.astype(np.float32)}
    return found
