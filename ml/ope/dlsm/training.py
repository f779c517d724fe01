"""Training of one DLSM ensemble member (Algorithm 1) with held-out selection, checkpoints and exact resumption."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ml.ope.dlsm.batches import Batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.held_out import Constant, FreeRuns, held_out
from ml.ope.dlsm.linear_part import LinearPart
from ml.ope.dlsm.networks import DlsmNetworks
from ml.ope.scale import Scale
from ml.progress import Report, silent
from ml.trajectories import ReplayBuffer


@dataclass(frozen=True)
class Member:
    """A trained ensemble member: its networks at the check that `keep` names, that check, and the course as (step, loss, score)."""

    networks: DlsmNetworks
    check: FreeRuns
    course: tuple[tuple[int, float, float], ...]


class MemberTraining:
    """One member's training, step by step, whose whole state goes into a checkpoint.

    Args:
        buffer: the sessions. batch: all of them as tensors. scale: their standardisation.
        `held`: indices of the held-out sessions, which decide when to stop.
        config: settings. seed: of initial weights, noise and batches.
        fingerprint: names buffer and settings; a checkpoint of another one is refused.
        learnt: indices of those that are learnt from, which may repeat; all others where it is not given.
    """

    def __init__(
        self,
        buffer: ReplayBuffer,
        batch: Batch,
        scale: Scale,
        held: Sequence[int],
        config: DlsmConfig,
        seed: int,
        fingerprint: str,
        learnt: Sequence[int] | None = None,
    ) -> None:
        self.config, self.scale, self.settings, self.seed = config, scale, buffer.settings, seed
        self.fingerprint = fingerprint
        self.held = tuple(held)
        others = [i for i in range(len(buffer.sessions)) if i not in set(held)]
        self.learnt = others if learnt is None else list(learnt)
        linear = LinearPart.fit(buffer, scale, self.learnt) if config.residual else None
        self.batch = batch if linear is None else linear.of(batch)
        self.held_batch = self.batch.select(held)
        self.constant = Constant.of(batch.select(self.learnt))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.networks = DlsmNetworks(buffer.settings.window, config)
            if linear is not None:
                self.networks.linear = linear
                self.networks.start_at_zero()
        self.optimizer = torch.optim.AdamW(
            self.networks.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, foreach=True
        )
        self.noise = torch.Generator().manual_seed(seed)
        self.picker = np.random.default_rng(seed)
        self.step, self.loss_sum, self.stale = 0, 0.0, 0
        self.course: list[tuple[int, float, float]] = []
        self.best: FreeRuns | None = None
        self.best_weights: dict[str, torch.Tensor] = {}

    @property
    def finished(self) -> bool:
        """True when all steps are done or the held-out score has stopped improving."""
        return self.step >= self.config.steps or self.stale >= self.config.patience

    def run(self, checkpoint: Path | None = None, report: Report = silent) -> Member:
        """Train to the end, going on from a checkpoint where there is one; the member is that of the check that `keep` names."""
        if checkpoint is not None and checkpoint.exists():
            self.load(checkpoint)
        if self.config.residual and not self.course:
            self.check()
            report(0.0, "fitting the deep latent sequential model", held_out_score=self.course[-1][2])
        while not self.finished:
            self.advance()
            if self.step % self.config.check_every == 0 or self.step == self.config.steps:
                self.check()
                if checkpoint is not None:
                    self.save(checkpoint)
                _, loss, score = self.course[-1]
                report(self.step / self.config.steps, "fitting the deep latent sequential model", loss=loss, held_out_score=score)
        if self.best is None:
            raise ValueError("the DLSM's held-out score was never a finite number: lower the learning rate")
        self.networks.load_state_dict(self.best_weights)
        self.networks.eval()
        return Member(self.networks, self.best, tuple(self.course))

    def advance(self) -> None:
        """Take one gradient step over a batch of sessions."""
        c = self.config
        chosen = self.learnt
        if len(chosen) > c.batch:
            chosen = sorted(self.picker.choice(chosen, c.batch, replace=False).tolist())
        batch = self.batch.select(chosen)
        rate = c.learning_rate * (0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * self.step / c.steps)))
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        loss = self.networks.loss(batch, self.networks.noise(*batch.size, self.noise))
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.networks.parameters(), c.clip_norm, error_if_nonfinite=True)
        self.optimizer.step()
        self.loss_sum += float(loss.detach())
        self.step += 1

    def check(self) -> None:
        """Score held-out sessions along free runs and remember the best weights."""
        steps_since = max(1, self.step - (self.course[-1][0] if self.course else 0))
        scored = self.score(self.held_batch, self.held)
        self.course.append((self.step, self.loss_sum / steps_since, scored.score))
        self.loss_sum = 0.0
        last = self.config.keep == "last"
        if math.isfinite(scored.score) and (last or self.best is None or scored.score < self.best.score):
            self.best, self.stale = scored, 0
            self.best_weights = {k: v.detach().clone() for k, v in self.networks.state_dict().items()}
        else:
            self.stale += 1

    def score(self, batch: Batch, sessions: tuple[int, ...]) -> FreeRuns:
        """Free runs of sessions that were not learnt from."""
        draws = self.config.replay_draws
        return held_out(self.networks, batch, sessions, self.constant, self.scale, self.settings, draws, seed=self.seed)

    def save(self, path: Path) -> None:
        """Write everything that training goes on from; the file appears whole or not at all."""
        state = {
            "fingerprint": self.fingerprint,
            "networks": self.networks.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "noise": self.noise.get_state(),
            "picker": json.dumps(self.picker.bit_generator.state),
            "progress": json.dumps(
                {
                    "step": self.step,
                    "loss_sum": self.loss_sum,
                    "stale": self.stale,
                    "course": self.course,
                    "best": None if self.best is None else self.best.to_json(),
                }
            ),
            "best_weights": self.best_weights,
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        with partial.open("wb") as file:
            torch.save(state, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)

    def load(self, path: Path) -> None:
        """Take up a checkpoint. Raises ValueError when it belongs to another buffer or other settings."""
        state: dict[str, Any] = torch.load(path, weights_only=True)
        if state["fingerprint"] != self.fingerprint:
            raise ValueError(
                f"the checkpoint {path.name} belongs to another buffer or other DLSM settings, such as those of an earlier betaloop; give "
                "this fit an empty checkpoint folder, or start the job again"
            )
        self.networks.load_state_dict(state["networks"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.noise.set_state(state["noise"])
        self.picker.bit_generator.state = json.loads(state["picker"])
        progress = json.loads(state["progress"])
        self.step, self.loss_sum, self.stale = progress["step"], progress["loss_sum"], progress["stale"]
        self.course = [(int(s), float(loss), float(score)) for s, loss, score in progress["course"]]
        self.best = None if progress["best"] is None else FreeRuns.from_json(progress["best"])
        self.best_weights = state["best_weights"]
