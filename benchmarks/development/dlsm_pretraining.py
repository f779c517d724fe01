"""Makes `ml/ope/dlsm/weights/pretrained.npz`, the weights that members of a DLSM start from, out of worlds of part A.

    python -m benchmarks.development.dlsm_pretraining --quick        two worlds, few steps, into a temporary folder
    python -m benchmarks.development.dlsm_pretraining                the file of the package

Worlds whose number is a multiple of six are left out: `dlsm_forms` measures on them. Every world's sessions are standardised on their own
and have a linear part of their own; designs go by turns. Half a CPU minute of one thread. The same command gives the same weights on
one kind of processor.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import torch

from ml.ope.dlsm.batches import Batch, make_batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.linear_part import LinearPart
from ml.ope.dlsm.networks import DlsmNetworks
from ml.ope.dlsm.pretrained import PATH, save
from ml.ope.scale import learn_scale
from ml.population.virtual import WORLDS_PER_PART, world

EVERY, MEASURED = 2, 6
STEPS, BATCH, RATE, SEED = 500, 24, 3e-3, 0
DESIGNS = ("stratified", "paper")


def sessions_of(index: int) -> Batch:
    """One world's sessions with what its linear part leaves."""
    buffer = world("A", index).data(DESIGNS[(index // EVERY) % len(DESIGNS)])  # type: ignore[arg-type]
    scale = learn_scale(buffer)
    usable = [i for i, s in enumerate(buffer.sessions) if s.usable().any()]
    return LinearPart.fit(buffer, scale, usable).of(make_batch(buffer, scale)).select(usable)


def joined(batches: list[Batch]) -> Batch:
    """Sessions of several buffers as one batch, padded to the longest with steps that are not alive."""
    longest = max(b.size[0] for b in batches)

    def column(name: str) -> torch.Tensor:
        parts = [getattr(b, name) for b in batches]
        if parts[0].ndim < 2 or name.startswith("outcome"):
            return torch.cat(parts)
        padded = [torch.cat([p, p[-1:].expand(longest - b.size[0], *p.shape[1:])]) for p, b in zip(parts, batches, strict=True)]
        if name in ("alive", "usable"):
            for p, b in zip(padded, batches, strict=True):
                p[b.size[0] :] = 0.0
        return torch.cat(padded, dim=1)

    return Batch(**{f.name: column(f.name) for f in fields(Batch)})


def main() -> None:
    """Fit, write the file, and print one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two worlds, few steps, into a temporary folder")
    parser.add_argument("--out", type=Path, help="the file to write; that of the package by default")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    indices = [i for i in range(1, WORLDS_PER_PART, EVERY) if i % MEASURED]
    steps, path = STEPS, chosen.out or PATH
    if chosen.quick:
        indices, steps = indices[:2], 10
        path = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-pretraining-")) / PATH.name
    began = time.process_time()
    batch = joined([sessions_of(i) for i in indices])
    config = DlsmConfig.expert()
    torch.manual_seed(SEED)
    networks = DlsmNetworks(batch.states.shape[2], config)
    networks.start_at_zero()
    optimizer = torch.optim.AdamW((p for p in networks.parameters() if p.requires_grad), lr=RATE, weight_decay=config.weight_decay)
    noise, picker = torch.Generator().manual_seed(SEED), np.random.default_rng(SEED)
    losses = []
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = RATE * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * step / steps)))
        part = batch.select(sorted(picker.choice(batch.size[1], min(BATCH, batch.size[1]), replace=False).tolist()))
        loss = networks.loss(part, networks.noise(*part.size, noise))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(networks.parameters(), config.clip_norm, error_if_nonfinite=True)
        optimizer.step()
        losses.append(float(loss.detach()))
    save(networks, path, f"{batch.size[1]} sessions of {len(indices)} worlds of part A, {steps} steps")
    seconds, first, last = time.process_time() - began, float(np.mean(losses[:20])), float(np.mean(losses[-20:]))
    sys.stdout.write(f"{path.name}: {path.stat().st_size} bytes, loss {first:.3f} to {last:.3f}, {seconds:.0f} CPU s\n")
    figures = {"first_loss": first, "last_loss": last, "seconds": seconds, "bytes": path.stat().st_size}
    sys.stdout.write(json.dumps({"name": "dlsm_pretraining", "figures": figures, "ratios": {}, "baseline": "none"}) + "\n")


if __name__ == "__main__":
    main()
