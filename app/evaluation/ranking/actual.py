"""What sessions really brought, in the terms of the estimates: the same horizon H, the same discount, the same constants of the reward."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ml.mdp import MdpSettings
from ml.outcomes import FIELDS
from ml.returns import ActualReturn, actual_return
from ml.trajectories import SessionTrajectory

QUANTITIES = ("energy", "mean_beta", *FIELDS)
"""What methods predict beside the return and sessions show: mean a^2, mean beta (participant's unit), outcomes."""


@dataclass(frozen=True)
class Actual(ActualReturn):
    """One session's result: its return, and `QUANTITIES` that it has, by name."""

    shown: dict[str, float] = field(default_factory=dict)

    @property
    def energy(self) -> float | None:
        """Mean of a^2 over the steps with a known amplitude; None where there is none."""
        return self.shown.get("energy")


def actual(session: SessionTrajectory, settings: MdpSettings, horizon_steps: int) -> Actual:
    """A session's actual return over H steps; QoCs, energy and beta are of the whole session, whatever H is."""
    found = actual_return(session, settings, horizon_steps)
    return Actual(found.step_return, found.end_reward, _shown(session))


def _shown(session: SessionTrajectory) -> dict[str, float]:
    amplitude = session.amplitude[~np.isnan(session.amplitude)]
    beta = session.beta[~np.isnan(session.beta)]
    found = {
        "energy": float(np.mean(amplitude**2)) if amplitude.size else None,
        "mean_beta": float(beta.mean()) if beta.size else None,
        **{name: getattr(session.qoc, name) for name in FIELDS},
    }
    return {name: float(value) for name, value in found.items() if value is not None}


def mean_of(values: Sequence[float | None]) -> float | None:
    """Mean of the known values; None where there is none."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None
