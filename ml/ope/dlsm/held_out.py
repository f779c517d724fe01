"""Held-out free-running prediction: how a DLSM is chosen, and how far its level may be off. No true return of any policy enters.

Sessions that a model has not learnt from are run freely from q(z_0 | s_0) under their own actions. Means over blocks of steps are compared,
since single steps are noise and the return follows levels. Each error is a share of that of a constant, the mean of the learnt sessions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ml.mdp import MdpSettings
from ml.ope.dlsm.batches import Batch
from ml.ope.dlsm.networks import DlsmNetworks
from ml.ope.doses import memories
from ml.ope.scale import Scale

Floats = NDArray[np.float64]

BLOCK = 30
"""Steps whose means are compared: about a minute."""

FEWEST_BLOCKS, LEAST_DOSE = 3, 0.03
"""Blocks of a session, and standard deviation of their doses, that show how beta moves with the dose within it."""


@dataclass(frozen=True)
class Constant:
    """Predictions of a model that has learnt nothing: means of the learnt sessions, standardised; outcomes [4]."""

    beta: float
    reward: float
    outcomes: tuple[float, ...]

    @classmethod
    def of(cls, batch: Batch) -> Constant:
        """Compute the means of a batch."""
        usable = batch.usable > 0
        mask = batch.outcome_mask
        outcomes = (batch.outcomes * mask).sum(0) / mask.sum(0).clamp(min=1)
        if not bool(usable.any()):
            return cls(0.0, 0.0, _floats(outcomes.numpy()))
        return cls(float(batch.states[1:, :, -1][usable].mean()), float(batch.rewards[usable].mean()), _floats(outcomes.numpy()))


@dataclass(frozen=True)
class SessionError:
    """One left-out session in a free run. Errors are mean squares of standardised values.

    Attributes:
        session: index in the buffer.
        beta, head, known: errors of block means of beta, and of the step reward by the learnt head and by the known reward.
        beta_constant, reward_constant: those of a constant.
        outcomes, outcomes_constant: mean over the measured outcomes; None where none was.
        beta_seen, beta_predicted: mean beta over the usable steps.
        dose_spread: sum of squares of the blocks' doses around the session's mean, 0 where it was not asked for.
        dose_seen, dose_predicted: slopes of beta on the dose over the blocks of the session.
    """

    session: int
    beta: float
    head: float
    known: float
    beta_constant: float
    reward_constant: float
    outcomes: float | None
    outcomes_constant: float | None
    beta_seen: float
    beta_predicted: float
    dose_spread: float = 0.0
    dose_seen: float = 0.0
    dose_predicted: float = 0.0


@dataclass(frozen=True)
class Shares:
    """Held-out errors as shares of a constant's: 0 is perfect, 1 no better than the mean of the learnt sessions.

    Attributes:
        beta, head, known: of block means. outcomes: None where none was measured.
        contrast: of the differences in mean beta between controllers, as a share of these differences. It is the answer to the action, free
            of a common error of all sessions. None where the sessions are of one controller.
        dose: of how beta moves with the dose within random sessions, as a share of that movement; None where it was not asked for.
    """

    beta: float
    head: float
    known: float
    outcomes: float | None
    contrast: float | None
    dose: float | None = None

    @property
    def score(self) -> float:
        """Criterion that selection minimises: the mean of the parts, the reward by whichever of its two sources predicts better."""
        parts = [self.beta, min(self.head, self.known), self.outcomes, self.contrast, self.dose]
        return float(np.mean([p for p in parts if p is not None]))


def shares(groups: Sequence[Sequence[SessionError]], kinds: Mapping[int, object] | None = None) -> Shares:
    """Average the errors of groups of sessions, each held out together; groups count alike, whatever their size.

    Args:
        groups: errors by group. kinds: controller of every session, for the contrast.

    Raises:
        ValueError: no session at all.
    """
    known = [list(g) for g in groups if g]
    if not known:
        raise ValueError("no left-out session has a usable step")

    def share(part: str, constant: str) -> float | None:
        pairs = [[(getattr(e, part), getattr(e, constant)) for e in g if getattr(e, part) is not None] for g in known]
        means = np.array([np.mean(p, axis=0) for p in pairs if p])
        return float(means[:, 0].sum() / max(float(means[:, 1].sum()), 1e-9)) if len(means) else None

    return Shares(
        beta=share("beta", "beta_constant") or 0.0,
        head=share("head", "reward_constant") or 0.0,
        known=share("known", "reward_constant") or 0.0,
        outcomes=share("outcomes", "outcomes_constant"),
        contrast=None if kinds is None else _contrast([e for g in known for e in g], kinds),
        dose=_dose_share([e for g in known for e in g]),
    )


def _dose_share(errors: Sequence[SessionError]) -> float | None:
    seen = sum(e.dose_spread * e.dose_seen**2 for e in errors)
    if seen <= 0:
        return None
    return float(sum(e.dose_spread * (e.dose_predicted - e.dose_seen) ** 2 for e in errors) / max(seen, 1e-9))


def _contrast(errors: Sequence[SessionError], kinds: Mapping[int, object]) -> float | None:
    by_kind: dict[object, list[tuple[float, float]]] = {}
    by_session: dict[int, list[tuple[float, float]]] = {}
    for e in errors:
        by_session.setdefault(e.session, []).append((e.beta_seen, e.beta_predicted))
    # a session that several members held out counts once
    for session, each in by_session.items():
        seen_mean, predicted_mean = np.mean(each, axis=0)
        by_kind.setdefault(kinds[session], []).append((float(seen_mean), float(predicted_mean)))
    if len(by_kind) < 2:
        return None
    seen, predicted = np.array([np.mean(v, axis=0) for v in by_kind.values()]).T
    seen, predicted = seen - seen.mean(), predicted - predicted.mean()
    return float(((predicted - seen) ** 2).sum() / max(float((seen**2).sum()), 1e-9))


@dataclass(frozen=True)
class FreeRuns:
    """Free runs of held-out sessions, their own actions replayed from q(z_0 | s_0).

    Attributes:
        score: `Shares.score` of these sessions, without the contrast: what early stopping minimises.
        errors: of every session with a usable step.
        error_head, error_known: mean squared error of the step reward by the learnt head, and by the known reward with P(beta >= xi).
        outcome_error: mean squared standardised error per outcome; None where none is held out.
        residual_head, residual_known: actual less predicted discounted step return, per session.
        residual_end: actual less predicted r_end, per session that has it.
        sessions: held-out sessions (index in the buffer).
    """

    score: float
    errors: tuple[SessionError, ...]
    error_head: float
    error_known: float
    outcome_error: tuple[float | None, ...]
    residual_head: tuple[float, ...]
    residual_known: tuple[float, ...]
    residual_end: tuple[float, ...]
    sessions: tuple[int, ...]

    def to_json(self) -> dict[str, Any]:
        """Return all numbers, by name."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> FreeRuns:
        """Read what `to_json` made."""
        fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**fields | {"errors": tuple(SessionError(**e) for e in values["errors"])})


@dataclass(frozen=True)
class _Predicted:
    """Means over free runs: beta standardised, P(beta >= xi) and reward standardised, [T, B]; outcomes standardised, [B, 4]."""

    beta: Floats
    above: Floats
    reward: Floats
    outcomes: Floats


def held_out(
    networks: DlsmNetworks,
    batch: Batch,
    sessions: tuple[int, ...],
    constant: Constant,
    scale: Scale,
    settings: MdpSettings,
    draws: int,
    seed: int,
) -> FreeRuns:
    """Score a DLSM on sessions it did not learn from; the same seed gives every check the same noise.

    Raises:
        ValueError: none of the sessions has a usable step.
    """
    run = _predict(networks, batch, draws, seed, float(scale.beta(np.array(settings.xi_beta))))
    contrast = networks.config.dose_contrast
    usable = batch.usable.numpy() > 0
    actions = batch.actions.numpy().astype(np.float64)
    actual = batch.rewards.numpy().astype(np.float64) * scale.reward_std + scale.reward_mean
    known = settings.r_a + (settings.r_b - settings.r_a) * run.above - settings.c1 * actions
    head = run.reward * scale.reward_std + scale.reward_mean if networks.config.reward_terms else known
    scaled = [(p - scale.reward_mean) / scale.reward_std for p in (head, known)]
    errors = [
        e
        for j, session in enumerate(sessions)
        if (e := _session_error(session, j, batch, usable[:, j], run, scaled, constant, contrast)) is not None
    ]
    mask = batch.outcome_mask.numpy() > 0
    squared = (batch.outcomes.numpy() - run.outcomes) ** 2
    discount = settings.gamma ** np.arange(actual.shape[0])[:, None] * usable
    end = (batch.outcomes.numpy()[:, 0] - run.outcomes[:, 0]) * scale.outcome_std[0]
    return FreeRuns(
        score=shares([errors]).score,
        errors=tuple(errors),
        error_head=_mean((actual - head) ** 2, usable),
        error_known=_mean((actual - known) ** 2, usable),
        outcome_error=tuple(float(squared[mask[:, j], j].mean()) if mask[:, j].any() else None for j in range(squared.shape[1])),
        residual_head=_floats((discount * (actual - head)).sum(0)),
        residual_known=_floats((discount * (actual - known)).sum(0)),
        residual_end=_floats(end[mask[:, 0]]),
        sessions=sessions,
    )


def _predict(networks: DlsmNetworks, batch: Batch, draws: int, seed: int, threshold: float) -> _Predicted:
    with torch.inference_mode():
        run = networks.replay(batch, draws, torch.Generator().manual_seed(seed))
        above = torch.special.ndtr((run.beta_mean - threshold) * torch.exp(-run.beta_log_std)).mean(1)
        means = run.beta_mean.mean(1), above, run.reward.mean(1), run.outcomes.mean(0)
    return _Predicted(*(m.numpy().astype(np.float64) for m in means))


def _session_error(
    session: int,
    j: int,
    batch: Batch,
    usable: NDArray[np.bool_],
    run: _Predicted,
    rewards: Sequence[Floats],
    constant: Constant,
    contrast: bool,
) -> SessionError | None:
    """Compute the errors of the batch's j-th session; None where it has no usable step."""
    beta = batch.states[1:, j, -1].numpy().astype(np.float64)
    reward = batch.rewards[:, j].numpy().astype(np.float64)
    steps = int(batch.lengths[j])

    def errors(seen: Floats, *predicted: Floats) -> Floats:
        return block_error(np.where(usable, seen, np.nan)[:steps], np.stack(predicted)[:, :steps])

    beta_errors = errors(beta, run.beta[:, j], np.full_like(beta, constant.beta))
    reward_errors = errors(reward, *(r[:, j] for r in rewards), np.full_like(reward, constant.reward))
    if not np.isfinite(beta_errors[1]):
        return None
    mask = batch.outcome_mask[j].numpy() > 0
    seen = batch.outcomes[j].numpy()[mask]
    ends = [float(np.mean((seen - p[mask]) ** 2)) for p in (run.outcomes[j], np.array(constant.outcomes))] if mask.any() else [None, None]
    contrast = contrast and bool(batch.randomised[j] > 0)  # a controller that follows beta turns the sign
    slopes = dose_slopes(batch.actions[:, j].numpy(), usable, beta, run.beta[:, j]) if contrast else (0.0, 0.0, 0.0)
    return SessionError(
        session=session,
        beta=float(beta_errors[0]),
        head=float(reward_errors[0]),
        known=float(reward_errors[1]),
        beta_constant=float(beta_errors[1]),
        reward_constant=float(reward_errors[2]),
        outcomes=ends[0],
        outcomes_constant=ends[1],
        beta_seen=float(beta[usable].mean()),
        beta_predicted=float(run.beta[usable, j].mean()),
        dose_spread=slopes[0],
        dose_seen=slopes[1],
        dose_predicted=slopes[2],
    )


def block_error(seen: Floats, predicted: Floats) -> Floats:
    """Compute the mean over blocks of the squared difference of block means, [C], for a trace [T] with NaN gaps and predictions of it, [C,
    T].

    A block counts when a third of it is known. Where none does, all known steps are one block. Without any the result is NaN.
    """
    known = np.isfinite(seen)
    if not known.any():
        return np.full(len(predicted), np.nan)
    blocks = [slice(first, first + BLOCK) for first in range(0, seen.size, BLOCK)]
    counted = [b for b in blocks if known[b].sum() >= BLOCK // 3] or [slice(None)]
    squares = [(predicted[:, b][:, known[b]].mean(1) - seen[b][known[b]].mean()) ** 2 for b in counted]
    return np.asarray(np.mean(squares, axis=0), dtype=np.float64)


def dose_slopes(actions: NDArray[Any], usable: NDArray[np.bool_], *betas: Floats) -> tuple[float, ...]:
    """Compute the sum of squares of a session's doses over blocks, and the slope of each beta [T] on them; zeros where doses hardly differ.

    The dose is the average over about 20 steps (`ml.ope.doses`); blocks as in `block_error`, of which three at least must count.
    """
    dose = memories(actions.astype(np.float64))[:, 1]
    blocks = [slice(first, first + BLOCK) for first in range(0, usable.size, BLOCK)]
    kept = [np.arange(usable.size)[b][usable[b]] for b in blocks if usable[b].sum() >= BLOCK // 3]
    if len(kept) < FEWEST_BLOCKS:
        return (0.0,) * (1 + len(betas))
    x = np.array([dose[k].mean() for k in kept])
    x = x - x.mean()
    spread = float(x @ x)
    if spread < LEAST_DOSE**2 * len(kept):
        return (0.0,) * (1 + len(betas))
    return (spread, *(float(x @ np.array([b[k].mean() for k in kept]) / spread) for b in betas))


def _mean(values: NDArray[Any], usable: NDArray[np.bool_]) -> float:
    return float(values[usable].mean()) if usable.any() else 0.0


def _floats(values: NDArray[Any]) -> tuple[float, ...]:
    return tuple(float(v) for v in values)
