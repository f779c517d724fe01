"""Held-out free-running prediction: how a DLSM is chosen, and how far its level may be off. No true return of any policy enters."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ml.mdp import MdpSettings
from ml.ope.batches import Batch, Scale
from ml.ope.dlsm_networks import DlsmNetworks, gaussian_log_prob

END_WEIGHT = 0.1
"""Weight of the outcomes' error in the score: few sessions are held out, and each has one outcome against hundreds of steps."""


@dataclass(frozen=True)
class HeldOut:
    """Free runs of held-out sessions, their own actions replayed from q(z_0 | s_0).

    Attributes:
        score: what selection minimises: negative log-likelihood of beta per step + standardised error of the reward + END_WEIGHT x the
            standardised error of r_end and the QoCs.
        beta_nll: negative log-likelihood of the standardised beta per step, marginal over free runs.
        error_head, error_known: mean squared error of the step reward by the learnt head, and by the known reward with P(beta >= xi).
        error_constant: the same of the sessions' own mean reward: a model above it has learnt nothing that follows the action.
        outcome_error: mean squared standardised error per outcome; None where none is held out.
        residual_head, residual_known: actual less predicted discounted step return, per session.
        residual_end: actual less predicted r_end, per session that has it.
        sessions: held-out sessions (index in the buffer).
    """

    score: float
    beta_nll: float
    error_head: float
    error_known: float
    error_constant: float
    outcome_error: tuple[float | None, ...]
    residual_head: tuple[float, ...]
    residual_known: tuple[float, ...]
    residual_end: tuple[float, ...]
    sessions: tuple[int, ...]

    def to_json(self) -> dict[str, Any]:
        """All numbers, by name."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> HeldOut:
        """The inverse of `to_json`."""
        fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**fields)


def held_out(
    networks: DlsmNetworks, batch: Batch, sessions: tuple[int, ...], scale: Scale, settings: MdpSettings, draws: int, seed: int
) -> HeldOut:
    """Score a DLSM on sessions it did not learn from; the same seed gives every check the same noise."""
    with torch.inference_mode():
        run = networks.replay(batch, draws, torch.Generator().manual_seed(seed))
        density = gaussian_log_prob(batch.states[1:, :, -1].unsqueeze(1), run.beta_mean, run.beta_log_std)
        log_beta = (torch.logsumexp(density, dim=1) - np.log(draws)).numpy().astype(np.float64)
        threshold = float(scale.beta(np.array(settings.xi_beta)))
        above = torch.special.ndtr((run.beta_mean - threshold) * torch.exp(-run.beta_log_std)).mean(1).numpy().astype(np.float64)
        head = run.reward.mean(1).numpy().astype(np.float64) * scale.reward_std + scale.reward_mean
        outcomes = run.outcomes.mean(0).numpy().astype(np.float64)
    usable = batch.usable.numpy() > 0
    actions = batch.actions.numpy().astype(np.float64)
    actual = batch.rewards.numpy().astype(np.float64) * scale.reward_std + scale.reward_mean
    known = settings.r_a + (settings.r_b - settings.r_a) * above - settings.c1 * actions
    error_head, error_known = (_mean((actual - p) ** 2, usable) for p in (head, known))
    mask = batch.outcome_mask.numpy() > 0
    squared = (batch.outcomes.numpy() - outcomes) ** 2
    outcome_error = tuple(float(squared[mask[:, j], j].mean()) if mask[:, j].any() else None for j in range(squared.shape[1]))
    seen = [e for e in outcome_error if e is not None]
    nll = -_mean(log_beta, usable)
    score = nll + min(error_head, error_known) / scale.reward_std**2 + END_WEIGHT * (float(np.mean(seen)) if seen else 0.0)
    discount = settings.gamma ** np.arange(actual.shape[0])[:, None] * usable
    end = (batch.outcomes.numpy()[:, 0] - outcomes[:, 0]) * scale.outcome_std[0]
    return HeldOut(
        score=score,
        beta_nll=nll,
        error_head=error_head,
        error_known=error_known,
        error_constant=_mean((actual - (actual * usable).sum(0) / np.maximum(usable.sum(0), 1)) ** 2, usable),
        outcome_error=outcome_error,
        residual_head=_floats((discount * (actual - head)).sum(0)),
        residual_known=_floats((discount * (actual - known)).sum(0)),
        residual_end=_floats(end[mask[:, 0]]),
        sessions=sessions,
    )


def _mean(values: NDArray[Any], usable: NDArray[np.bool_]) -> float:
    return float(values[usable].mean()) if usable.any() else 0.0


def _floats(values: NDArray[Any]) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
