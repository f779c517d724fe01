"""Off-policy evaluation by replaying logged sessions in the impulse-response model; all but the dynamics is as in `ml.ope.linear`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ml.ope.impulse.dynamics import ResponseTable, fit_impulse
from ml.ope.lead import dose_before
from ml.ope.linear.estimator import FittedLinear, LinearConfig
from ml.ope.outcomes.model import fit_end_model
from ml.ope.registry import Size
from ml.ope.scale import learn_scale
from ml.progress import Report, silent
from ml.trajectories import ReplayBuffer


@dataclass(frozen=True)
class ImpulseModel:
    """The estimator."""

    config: LinearConfig = field(default_factory=LinearConfig)
    method: str = "impulse"

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> FittedLinear:
        """Fit dynamics and outcomes; takes seconds, so nothing is kept in `checkpoint_dir`.

        Raises:
            ValueError: fewer than two sessions with usable steps.
        """
        c, scale = self.config, learn_scale(buffer)
        before = dose_before(buffer)
        tables = [ResponseTable.of(s, scale, before) for s in buffer.sessions]
        draws = max(20, min(c.draws, c.most_rows // len(tables)))
        drawn = fit_impulse(buffer, tables, draws, c.seed, before)
        report(0.7, "fitting the response of beta")
        severity = drawn.levels.mean(0)
        ends = fit_end_model(buffer, draws=draws, seed=c.seed, severity=severity)
        report(1.0, "fitting the response of beta")
        return FittedLinear(self.method, c, buffer, scale, tuple(tables), drawn, drawn, ends.part(0, 0), ends, None)


def build(key: str, seed: int, size: Size) -> ImpulseModel:
    """Build the estimator, as the registry asks for it."""
    return ImpulseModel(LinearConfig(seed=seed, draws=20) if size == "held_out" else LinearConfig(seed=seed))
