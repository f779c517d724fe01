"""Worlds that the constants of the posterior are learned from, each with a record and with what is true of its candidates."""

from __future__ import annotations

import pickle
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ml.ope.posterior.estimator import CDBS, Posterior, PosteriorConfig
from ml.ope.posterior.learned.evidence import UNITS, Evidence, reach_of
from ml.ope.posterior.support import SessionSupport
from ml.policies.policy import ConstantPolicy, Policy
from ml.population.virtual import training_world
from ml.population.virtual.world import STEPS

Floats = NDArray[np.float64]

TRUE_SESSIONS = 60
VISITS = (1, 2, 3, 3, 3, 3, 3, 3, 3, 4)
DRAWS = 24
QOCS = tuple(UNITS)[1:]


@dataclass(frozen=True)
class Cell:
    """One world with one record.

    Attributes:
        world: its name. truth: true differences to cDBS in `UNITS`, [P, 4]. returns: weights of the four in the return, [4].
        evidence: of its policies.
        cdbs: return of the steps and outcomes of every session replayed under cDBS, [n, 4] in `UNITS`. visits: of them.
        level: true one, [4].
    """

    world: str
    truth: Floats
    returns: Floats
    evidence: Evidence
    cdbs: Floats
    visits: NDArray[np.int64]
    level: Floats


def simulated(number: int, folder: Path) -> list[Cell]:
    """Cells of so many worlds; those that an earlier run has made are read."""
    folder.mkdir(parents=True, exist_ok=True)
    start, found = time.monotonic(), []
    for index in range(number):
        path = folder / f"{index:06d}.pkl"
        if not path.exists():
            path.write_bytes(pickle.dumps(cell(index)))
        found.append(pickle.loads(path.read_bytes()))
        if index % 50 == 49:
            sys.stdout.write(f"{index + 1} worlds, {time.monotonic() - start:.0f} s\n")
    return found


def cell(index: int) -> Cell:
    """A record by one of the designs with fitted structures."""
    w, rng = training_world(index), np.random.default_rng([index, 77])
    design, visits = ("stratified" if rng.random() < 0.5 else "paper"), int(rng.choice(VISITS))
    everyone: dict[str, Policy] = {**w.candidates(), CDBS: ConstantPolicy(1.0)}
    truths = [w.truth(p, TRUE_SESSIONS) for p in everyone.values()]
    buffer = w.data(design, seed=index % 7, visits=visits)  # type: ignore[arg-type]
    fitted = Posterior(PosteriorConfig(draws=DRAWS)).fit(buffer)
    replays = fitted.replays(list(everyone.values()), STEPS)
    support = SessionSupport(buffer)
    found = fitted.evidence(replays, np.array([support.of(s).leverage for s in replays.summaries]), STEPS)
    units = np.array([reach_of(buffer, STEPS), *(UNITS[name] for name in QOCS)])
    steps = np.einsum("dn,d->n", replays.step_return[-1], replays.weights)
    outcomes = np.einsum("dnq,d->nq", replays.outcomes[-1], replays.weights)[:, 1:]
    cdbs = np.concatenate([steps[:, None], outcomes], axis=1) / units
    rows = np.array([[t.step_return[0], *(getattr(t, name)[0] for name in QOCS)] for t in truths]) / units
    tremor = -w.settings.c4 * UNITS["tremor_percent"] / (100.0 if w.settings.tremor_as_fraction else 1.0)
    returns = np.array([units[0], w.settings.c2 * UNITS["grasp_hz"], w.settings.c3 * UNITS["rating"], tremor])
    return Cell(w.name, rows - rows[-1], returns, found, cdbs, np.array([s.visit for s in buffer.sessions]), rows[-1])
