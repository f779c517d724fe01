"""Choice among settings of a DLSM by held-out free-running prediction, on the sessions of one buffer.

Sessions are left out in two ways: groups of all kinds, and, where there are several, whole controllers, which asks what a new policy asks.
A model is trained on the others, of which some say when to stop, and the sessions left out are run freely under their own actions. Neither
the evidence lower bound nor the return of any policy enters.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ml.ope.behaviour import controller_key, controllers
from ml.ope.dlsm.batches import Batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.held_out import FreeRuns, Shares, shares
from ml.ope.dlsm.training import MemberTraining
from ml.ope.scale import Scale, session_folds
from ml.progress import Report, part_of, silent
from ml.trajectories import ReplayBuffer

GROUPS = 3
"""Groups of all kinds of sessions, each left out once."""


@dataclass(frozen=True)
class Selection:
    """The settings that predicted left-out sessions best.

    Attributes:
        chosen: index among the candidates. scores: of every candidate, lower is better, 1 is a constant.
        shares: of every candidate, by way of leaving out.
    """

    chosen: int
    scores: tuple[float, ...]
    shares: tuple[tuple[Shares, ...], ...]

    def to_json(self) -> dict[str, Any]:
        """All numbers, by name."""
        return asdict(self)


class SelectionRun:
    """Trains every candidate once per left-out group; finished trainings are kept in the checkpoint folder.

    Args:
        buffer, batch, scale: the sessions. candidates: settings. seed: of groups and trainings.
        fingerprint: names buffer and candidates; results of others are refused.
    """

    def __init__(
        self, buffer: ReplayBuffer, batch: Batch, scale: Scale, candidates: Sequence[DlsmConfig], seed: int, fingerprint: str
    ) -> None:
        self.buffer, self.batch, self.scale = buffer, batch, scale
        self.candidates, self.seed, self.fingerprint = tuple(candidates), seed, fingerprint
        self.ways = leave_out(buffer, seed)
        self.done: dict[str, FreeRuns] = {}

    def run(self, checkpoint_dir: Path | None = None, report: Report = silent) -> Selection:
        """Train what is not finished and compare."""
        results = None if checkpoint_dir is None else checkpoint_dir / "dlsm-selection.json"
        if results is not None and results.exists():
            self._load(results)
        work = [(i, w, f) for i in range(len(self.candidates)) for w, way in enumerate(self.ways) for f in range(len(way))]
        for k, (i, w, f) in enumerate(work):
            key = f"{i}-{w}-{f}"
            if key in self.done:
                continue
            partial = None if checkpoint_dir is None else checkpoint_dir / f"dlsm-selection-{key}.pt"
            self.done[key] = self._predict(i, self.ways[w][f], f"{self.fingerprint} {key}", partial, part_of(report, k, len(work)))
            if results is not None and partial is not None:
                self._save(results)
                partial.unlink(missing_ok=True)
        return self._compare()

    def _predict(self, i: int, left_out: list[int], fingerprint: str, checkpoint: Path | None, report: Report) -> FreeRuns:
        """Free runs of sessions that neither trained nor stopped the model."""
        config = self.candidates[i]
        held = usable_folds(self.buffer, config.held_out, self.seed, without=left_out)[0]
        training = MemberTraining(self.buffer, self.batch, self.scale, held, config, self.seed, fingerprint, left_out)
        training.run(checkpoint, report)
        return training.score(training.batch.select(left_out), tuple(left_out))

    def _compare(self) -> Selection:
        kinds = {k: controller_key(s) for k, s in enumerate(self.buffer.sessions)}
        table = [
            tuple(shares([self.done[f"{i}-{w}-{f}"].errors for f in range(len(way))], kinds) for w, way in enumerate(self.ways))
            for i in range(len(self.candidates))
        ]
        scores = [float(np.mean([s.score for s in row])) for row in table]
        return Selection(int(np.argmin(scores)), tuple(scores), tuple(table))

    def _save(self, path: Path) -> None:
        partial = path.with_suffix(".partial")
        state = {"fingerprint": self.fingerprint, "done": {key: found.to_json() for key, found in self.done.items()}}
        with partial.open("w") as file:
            json.dump(state, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)

    def _load(self, path: Path) -> None:
        state = json.loads(path.read_text())
        if state["fingerprint"] != self.fingerprint:
            raise ValueError(f"{path.name} belongs to another buffer or other DLSM settings; give this fit an empty checkpoint folder")
        self.done = {key: FreeRuns.from_json(found) for key, found in state["done"].items()}


def leave_out(buffer: ReplayBuffer, seed: int) -> list[list[list[int]]]:
    """Ways of leaving sessions out: `GROUPS` groups of all kinds, and whole controllers; two usable sessions always remain."""
    n = sum(len(group) for group in controllers(buffer).values())
    ways = [usable_folds(buffer, 1 / GROUPS, seed), list(controllers(buffer).values())]
    kept = [[group for group in way if n - len(group) >= 2] for way in ways]
    return [way for way in kept if len(way) > 1]


def usable_folds(buffer: ReplayBuffer, share: float, seed: int, without: Sequence[int] = ()) -> list[list[int]]:
    """Indices of the sessions with a usable step, save some, in groups of about `share` of them each, at least two groups."""
    usable = [i for i, s in enumerate(buffer.sessions) if s.usable().any() and i not in set(without)]
    folds = session_folds([buffer.sessions[i] for i in usable], max(2, round(1 / share)), seed)
    return [[usable[k] for k in fold] for fold in folds]


FEWEST_HELD = 2
"""Sessions that a resampled member must not have learnt from."""


def resampled(buffer: ReplayBuffer, seed: int) -> tuple[list[int], list[int]]:
    """Indices of sessions drawn with replacement, as many as are usable, and of those that were not drawn."""
    usable = [i for i, s in enumerate(buffer.sessions) if s.usable().any()]
    rng = np.random.default_rng([seed, 0xB007])
    while True:
        drawn = sorted(int(i) for i in rng.choice(usable, len(usable)))
        held = [i for i in usable if i not in set(drawn)]
        if len(held) >= FEWEST_HELD and len(set(drawn)) >= FEWEST_HELD:
            return drawn, held
