"""Check of whether the members of an ensemble answer to a lasting dose as the data do.

In a random session the dose is drawn, so how beta moves with it within the session is an experiment. The level of the session cancels. A
controller that follows beta gives more where beta is high, which would turn the sign: its sessions do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.special import stdtrit

from ml.ope.dlsm.batches import Batch
from ml.ope.dlsm.held_out import dose_slopes
from ml.ope.dlsm.networks import DlsmNetworks
from ml.ope.doses import memories

FEWEST_SESSIONS = 4
"""Random sessions with doses that differ, below which the data say nothing."""

TOLD = 0.975
"""One-sided confidence (Student's t over sessions) with which the answer of the data must differ from zero."""

LEAST_SHARE = 0.1
"""An answer below this share of that of the data is null."""

DRAWS = 2
STEPS = 150
"""Steps of the free runs at constant doses, of which the later half counts."""


@dataclass(frozen=True)
class DoseAnswer:
    """Change of standardised beta per unit of the dose (1: from none to cDBS) within random sessions.

    Attributes:
        slope: pooled over sessions. error: its standard error, over sessions. sessions: that inform it.
        low, high: doses between which members are asked for theirs: the lower and upper decile of those in random sessions.
    """

    slope: float
    error: float
    sessions: int
    low: float
    high: float

    @property
    def told(self) -> bool:
        """True where the answer differs clearly from zero, so that members are asked for theirs."""
        if self.sessions < FEWEST_SESSIONS or not self.high > self.low:
            return False
        return abs(self.slope) > float(stdtrit(self.sessions - 1, TOLD)) * self.error

    def holds_against(self, slope: float) -> bool:
        """Decide whether a member's answer is null, or of the other sign, where that of the data is known."""
        return self.told and slope / self.slope < LEAST_SHARE

    def to_json(self) -> dict[str, Any]:
        """Return all numbers, by name, and whether the answer is known."""
        return asdict(self) | {"told": self.told}


def answer_of_data(batch: Batch) -> DoseAnswer:
    """Compute the answer of the random sessions of a whole buffer."""
    usable = batch.usable.numpy() > 0
    found, doses = [], []
    for j in np.flatnonzero(batch.randomised.numpy() > 0):
        actions = batch.actions[:, j].numpy().astype(np.float64)
        spread, slope = dose_slopes(actions, usable[:, j], batch.states[1:, j, -1].numpy().astype(np.float64))
        if spread > 0:
            doses.append(memories(actions)[usable[:, j], 1])
            found.append((spread, slope))
    if len(found) < 2:
        return DoseAnswer(0.0, float("inf"), len(found), 0.0, 0.0)
    spreads, slopes = np.array(found).T
    pooled = float(spreads @ slopes / spreads.sum())
    n = len(found)
    error = float(np.sqrt(n / (n - 1) * np.sum((spreads * (slopes - pooled)) ** 2)) / spreads.sum())
    low, high = np.quantile(np.concatenate(doses), [0.1, 0.9])
    return DoseAnswer(pooled, error, n, float(low), float(high))


def answer_of_member(networks: DlsmNetworks, batch: Batch, low: float, high: float, seed: int) -> float:
    """Compute the same of a model: free runs of all sessions of the whole buffer at the two doses with the same noise."""
    means = []
    for dose in (low, high):
        steps = min(STEPS, batch.size[0])
        actions = torch.full_like(batch.actions, dose)
        held = replace(batch, actions=actions)
        if networks.linear is not None:
            held = networks.linear.of(held)
        held = held.cut(steps)
        with torch.inference_mode():
            run = networks.replay(held, DRAWS, torch.Generator().manual_seed(seed))
        means.append(float(run.beta_mean[steps // 2 :].mean()))
    return (means[1] - means[0]) / (high - low)


@dataclass(frozen=True)
class Judged:
    """Judgement of every member by the data: their answer, those of the members, and the members to exclude."""

    data: DoseAnswer
    members: tuple[float, ...]
    discarded: tuple[int, ...]

    def to_json(self) -> dict[str, Any]:
        """Return all numbers, by name."""
        return {"data": self.data.to_json(), "members": list(self.members), "discarded": list(self.discarded)}

    def sentence(self) -> str:
        """Explain why no member is left, with the numbers."""
        data, said = self.data, ", ".join(f"{slope:+.2f}" for slope in self.members)
        return (
            f"no two members of the DLSM answer to a lasting dose as the data do: within {data.sessions} random sessions beta changes by "
            f"{data.slope:+.2f} ± {data.error:.2f} of its standard deviation from no stimulation to cDBS, in the members by {said}"
        )


def judge(networks: Sequence[DlsmNetworks], batch: Batch, seed: int) -> Judged:
    """Compare the members with the random sessions; where those show nothing, all members stay."""
    data = answer_of_data(batch)
    if not data.told:
        return Judged(data, (), ())
    slopes = tuple(answer_of_member(n, batch, data.low, data.high, seed) for n in networks)
    return Judged(data, slopes, tuple(k for k, slope in enumerate(slopes) if data.holds_against(slope)))
