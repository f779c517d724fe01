"""Fitted Q evaluation with the horizon as an index, in closed form. Source: Le, Voloshin and Yue 2019; linear: Duan and Wang 2020.

Q_tau(s, a) is the return of the next tau steps. It is linear in fixed features (polynomial ones and random tanh units), so that one
backward step is one product with a small matrix. 300 steps cost milliseconds, and refits on resampled sessions are affordable. No stopping
rule, target network or learning rate is left to choose. r_end is not discounted (gamma^299 = 0.05 would erase it). It follows averages over
the steps of a session, so their expectations are undiscounted Q functions of the same features. There is one head for each column of
`fqe.steps.RATES`: the discounted sum of rewards, and the sums that outcomes follow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ml.mdp import MdpSettings
from ml.ope.estimate import LEVEL, OUTCOMES, Estimate, checked_horizon, require_two_sessions
from ml.ope.flags import FEW_END_REWARDS
from ml.ope.fqe.steps import RATES, TargetActions, UsableSteps, ValueFeatures, usable_steps
from ml.ope.lead import dose_before
from ml.ope.observed import day_noise
from ml.ope.outcomes.minutes import ABOVE, AMPLITUDE, BETA, ENERGY, Minutes, step_features
from ml.ope.outcomes.model import EndModel, fit_end_model
from ml.ope.registry import Size
from ml.ope.scale import session_folds
from ml.ope.support.coverage import AmplitudeSupport
from ml.policies.policy import Policy
from ml.progress import Report, silent
from ml.statistics.bootstrap import percentile_interval, resampled, resamples
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

PENALTIES = tuple(float(v) for v in 10.0 ** np.arange(-5.0, 0.0))
"""Ridge penalties per logged step, on standardised features."""

LARGEST_ROOT = 1.001
"""Spectral radius of the transition matrix above which the penalty is raised: it would grow over the horizon."""

CHECK_STEPS = 50
"""Length of the returns on left-out sessions that choose the penalty."""


def backward_induction(transition: Floats, reward: Floats, discount: Floats, horizon: int) -> Floats:
    """Compute the weights of Q_0 ... Q_H.

    Args:
        transition: regression of the next step's features on this step's, [F, F]. reward: of the K rewards, [F, K].
        discount: of each head, [K]. horizon: H.

    Returns:
        w_tau = reward + discount transition w_{tau - 1}, w_0 = 0; shape [H + 1, F, K].
    """
    weights = np.zeros((horizon + 1, *reward.shape))
    for tau in range(1, horizon + 1):
        weights[tau] = reward + (transition @ weights[tau - 1]) * discount
    return weights


def discounts(gamma: float) -> Floats:
    """Return the discount of every head, [R]: sums that outcomes follow are not discounted."""
    return np.array([gamma] + [1.0] * (RATES - 1))


@dataclass(frozen=True, kw_only=True)
class FqeConfig:
    """Settings of fitted Q evaluation.

    Attributes:
        members: sets of random features, whose values are averaged. units: random features of each.
        refits: refits on resampled sessions, shared out over the members; they make the interval.
        folds: groups of sessions that choose the penalty. seed: of features, resamples and folds.
    """

    members: int = 3
    units: int = 48
    refits: int = 60
    folds: int = 4
    seed: int = 0


class Grams:
    """Sums over the steps of each session that a regression on features needs: [n, F, F] and [n, F, K]."""

    def __init__(self, table: UsableSteps, phi: Floats) -> None:
        self.table, self.phi = table, phi
        self.bounds = np.searchsorted(table.session, np.arange(table.sessions + 1))
        self.square = self.product(phi)
        self.reward = self.product(table.rates)

    def product(self, other: Floats) -> Floats:
        """Compute Phi^T other, per session, [n, F, ...]."""
        parts = [self.phi[i:j].T @ other[i:j] for i, j in zip(self.bounds, self.bounds[1:], strict=False)]
        return np.stack(parts)

    def solve(self, pick: Indices, penalty: float, *sides: Floats) -> tuple[Floats, ...]:
        """Solve ridge regressions of per-session products [n, F, .] on the features, over the picked sessions; the constant is not
        penalised."""
        gram = self.square[pick].sum(0)
        ridge = np.full(len(gram), penalty * gram[0, 0])
        ridge[0] = 1e-9 * gram[0, 0]
        gram = gram + np.diag(ridge)
        solved = np.linalg.solve(gram, np.concatenate([side[pick].sum(0) for side in sides], axis=1))
        return tuple(np.split(solved, np.cumsum([side.shape[2] for side in sides])[:-1], axis=1))


@dataclass(frozen=True)
class QMember:
    """One set of features over a buffer, and the penalty that predicts left-out sessions best."""

    features: ValueFeatures
    grams: Grams
    penalty: float

    def next_products(self, target: TargetActions) -> Floats:
        """Compute Phi^T Phi' under a policy, per session, [n, F, F]."""
        return self.grams.product(self.features(self.grams.table.next_states, target.then, target.memory))

    def weights(self, products: Floats, pick: Indices, horizon: int, gamma: float) -> tuple[Floats, float]:
        """Compute the weights of Q_0 ... Q_H for every head, [H + 1, F, R], and the penalty used: raised until nothing grows over the
        horizon."""
        penalty = self.penalty
        while True:
            transition, reward = self.grams.solve(pick, penalty, products, self.grams.reward)
            if spectral_radius(transition) <= LARGEST_ROOT or penalty >= 1e3:
                return backward_induction(transition, reward, discounts(gamma), horizon), penalty
            penalty *= 10.0


def spectral_radius(matrix: Floats) -> float:
    """Compute the largest modulus of an eigenvalue."""
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def fit_member(table: UsableSteps, folds: Sequence[Sequence[int]], gamma: float, units: int, seed: int) -> QMember:
    """Fit features of one seed with the penalty whose predictions of `CHECK_STEPS`-step returns on held-out sessions are best."""
    features = ValueFeatures(table, units, seed)
    phi = features(table.states, table.actions, table.memory)
    grams = Grams(table, phi)
    rows, returns = logged_returns(table, gamma, CHECK_STEPS)
    follows = table.follows >= 0
    # The logged next step replaces the policy here: the prediction is of what the logged controllers went on to collect.
    logged = Grams(replace_steps(table, follows), phi[follows])
    products = logged.product(phi[table.follows[follows]])
    errors = np.full(len(PENALTIES), np.inf)
    discount = np.array([gamma])
    for j, penalty in enumerate(PENALTIES if rows.size else ()):
        squared = 0.0
        for fold in folds:
            rest = np.setdiff1d(np.arange(table.sessions), fold)
            if rest.size == 0 or logged.square[rest, 0, 0].sum() < 1:
                continue
            transition, reward = logged.solve(rest, penalty, products, logged.reward[:, :, :1])
            weights = backward_induction(transition, reward, discount, CHECK_STEPS)[-1]
            held = np.isin(table.session[rows], fold)
            squared += float(np.sum((phi[rows[held]] @ weights[:, 0] - returns[held]) ** 2))
        errors[j] = squared if np.isfinite(squared) else np.inf
    best = int(np.argmin(errors)) if np.isfinite(errors).any() else 2
    return QMember(features, grams, PENALTIES[best])


def logged_returns(table: UsableSteps, gamma: float, steps: int) -> tuple[Indices, Floats]:
    """Find rows that are followed by enough usable steps, and the discounted sums of their next `steps` rewards."""
    rewards = table.rates[:, 0]
    if len(rewards) < steps:
        return np.empty(0, dtype=np.int64), np.empty(0)
    run = np.zeros(len(rewards), dtype=np.int64)
    for k in range(len(rewards) - 2, -1, -1):
        run[k] = run[k + 1] + 1 if table.follows[k] >= 0 else 0
    rows = np.flatnonzero(run >= steps - 1)
    sums = np.convolve(rewards, (gamma ** np.arange(steps))[::-1], mode="valid")
    return rows, sums[rows]


def replace_steps(table: UsableSteps, keep: NDArray[np.bool_]) -> UsableSteps:
    """Select some steps of the table; `follows` loses its meaning and is -1."""
    return UsableSteps(
        table.scale,
        table.states[keep],
        table.next_states[keep],
        table.actions[keep],
        table.memory[keep],
        table.rates[keep],
        table.session[keep],
        table.step[keep],
        np.full(int(keep.sum()), -1, dtype=np.int64),
        table.first_states,
        table.first_session,
        table.sessions,
        table.before,
        table.otherwise,
    )


def minutes_of(sums: Floats, horizon: int) -> Minutes:
    """Convert sums over the horizon [..., R] to sessions as the outcome model sees them, [...]: one minute that represents all."""
    return Minutes.of_means(sums[..., 1:] / horizon)


def within_reach(
    sums: Floats, settings: MdpSettings, horizon: int, beta_range: tuple[float, float], span: tuple[float, float] = (0.0, 1.0)
) -> Floats:
    """Limit sums of the heads [..., R] to what H steps can reach under a policy whose amplitudes are within `span`."""
    discounted = float(np.sum(settings.gamma ** np.arange(horizon)))
    low, high = horizon * step_features(np.array(beta_range), np.array(span), settings.xi_beta)
    low[ABOVE], high[ABOVE] = 0.0, horizon
    least = np.append((settings.r_b - settings.c1 * span[1]) * discounted, low)
    most = np.append((settings.r_a - settings.c1 * span[0]) * discounted, high)
    return np.asarray(np.clip(sums, least, most), dtype=np.float64)


@dataclass(frozen=True)
class Fqe:
    """The estimator."""

    config: FqeConfig = field(default_factory=FqeConfig)
    method: str = "fqe"

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> FittedFqe:
        """Fit features and penalties; this takes seconds, so nothing is written to `checkpoint_dir`.

        Raises:
            ValueError: fewer than two sessions with usable steps, or no session with a complete s_0.
        """
        table, c = usable_steps(buffer, otherwise=dose_before(buffer)), self.config
        require_two_sessions("fitted Q evaluation", len(np.unique(table.session)))
        folds = session_folds(buffer.sessions, c.folds, c.seed)
        members = []
        for m in range(c.members):
            members.append(fit_member(table, folds, buffer.settings.gamma, c.units, c.seed + 1000 * m))
            report((m + 1) / c.members, "choosing the penalty of the value function")
        draws = resamples(table.sessions, c.refits, c.seed)
        return FittedFqe(self.method, c, buffer, table, tuple(members), draws, fit_end_model(buffer, draws=c.refits, seed=c.seed))


@dataclass(frozen=True)
class FittedFqe:
    """Features, penalties, and the resamples that every policy shares."""

    method: str
    config: FqeConfig
    buffer: ReplayBuffer
    table: UsableSteps
    members: tuple[QMember, ...]
    draws: Indices
    end: EndModel

    def evaluate(self, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Report = silent) -> dict[str, Estimate]:
        """Estimate every policy from the sessions' own s_0."""
        horizon = checked_horizon(self.buffer, horizon_steps)
        support = AmplitudeSupport(self.buffer)
        estimates = {}
        for k, (name, policy) in enumerate(policies.items()):
            estimates[name] = self._estimate(policy, horizon, support)
            report((k + 1) / len(policies), "evaluating value functions")
        return estimates

    def _estimate(self, policy: Policy, horizon: int, support: AmplitudeSupport) -> Estimate:
        table, c, settings = self.table, self.config, self.buffer.settings
        target = TargetActions.of(table, policy)
        everything = np.arange(table.sessions)
        starts = [m.features(table.first_states, target.first, table.first_memory(target.first)) for m in self.members]
        products = [m.next_products(target) for m in self.members]
        mains, penalties = [], []
        for member, start, product in zip(self.members, starts, products, strict=True):
            weights, penalty = member.weights(product, everything, horizon, settings.gamma)
            mains.append(start.mean(0) @ weights[-1])
            penalties.append(penalty)
        refits = np.empty((c.refits, RATES))
        for d, pick in enumerate(self.draws):
            k = d % c.members
            weights, _ = self.members[k].weights(products[k], pick, horizon, settings.gamma)
            own = np.isin(table.first_session, pick)
            refits[d] = starts[k][own if own.any() else slice(None)].mean(0) @ weights[-1]
        beta_range = (table.scale.beta_low, table.scale.beta_high)
        main = within_reach(np.mean(mains, axis=0), settings, horizon, beta_range, target.span)
        refits = within_reach(refits, settings, horizon, beta_range, target.span)
        extra = {
            "penalty": penalties,
            "member_values": [float(m[0]) for m in mains],
            "raised_penalty": any(p > m.penalty for p, m in zip(penalties, self.members, strict=True)),
        }
        return value_estimate(self, main, refits, policy, horizon, support, extra)


class Seeded(Protocol):
    """Settings with the seed of the resamples."""

    @property
    def seed(self) -> int: ...


class ValueSource(Protocol):
    """Parts of a fitted method that `value_estimate` needs."""

    @property
    def method(self) -> str: ...
    @property
    def config(self) -> Seeded: ...
    @property
    def table(self) -> UsableSteps: ...
    @property
    def buffer(self) -> ReplayBuffer: ...
    @property
    def end(self) -> EndModel: ...


def value_estimate(
    fitted: ValueSource,
    main: Floats,
    refits: Floats,
    policy: Policy,
    horizon: int,
    support: AmplitudeSupport,
    details: Mapping[str, object],
    end_shift: tuple[float, Floats] | None = None,
) -> Estimate:
    """Build an estimate from sums of the heads [R] and those of every refit [D, R]; `end_shift` is added to r_end and to its refits [D]."""
    with_end = fitted.end.seen[0]
    minutes = minutes_of(main, horizon)
    outcomes, means = fitted.end.predict(minutes), minutes.means
    shift, shifts = (0.0, np.zeros(len(refits))) if end_shift is None else end_shift
    end = float(outcomes[0]) + shift if with_end else 0.0
    draws = refits[:, 0].copy()
    if with_end:
        draws += fitted.end.each(minutes_of(refits[:, None], horizon))[:, 0, 0] + shifts
    value = float(main[0]) + end
    noise, unknown = day_noise(fitted.buffer, horizon, len(draws), 0)
    draws = draws - draws.mean()
    interval = percentile_interval(np.add.outer(draws, noise).ravel() + value, LEVEL)
    logged = support.of_policy(policy)
    flags = list(logged.flags())
    if not with_end:
        flags.append(FEW_END_REWARDS)
    flags += [unknown] if unknown else []
    predicted = {"energy": float(means[ENERGY]), "mean_amplitude": float(means[AMPLITUDE]), "mean_beta": float(means[BETA])}
    predicted |= {name: float(outcomes[j]) for j, name in enumerate(OUTCOMES) if j and fitted.end.seen[j]}
    return Estimate(
        method=fitted.method,
        value=value,
        low=interval.low,
        high=interval.high,
        level=LEVEL,
        standard_error=interval.standard_error,
        step_return=float(main[0]),
        end_reward=end if with_end else None,
        predicted=predicted,
        supported=logged.supported,
        flags=tuple(flags),
        n=fitted.table.sessions,
        details={
            "horizon_steps": horizon,
            **details,
            "coverage": logged.to_json(),
            "draws": [round(float(d + value), 4) for d in draws],
            "resampled": resampled(fitted.table.sessions, fitted.config.seed),
        },
    )


def build(key: str, seed: int, size: Size) -> Fqe:
    """Build the estimator at a size of `ml.ope.registry`."""
    configs = {
        "full": FqeConfig(seed=seed),
        "demo": FqeConfig(seed=seed, members=1, refits=30),
        "held_out": FqeConfig(seed=seed, refits=25),
    }
    return Fqe(configs[size], key)
