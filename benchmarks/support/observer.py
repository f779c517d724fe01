"""An observer that knows how a virtual patient came about and must infer its constants from the data: the best possible inference.

The observer knows the mechanism, the trait, the distribution of the constants, the threshold, the candidates and the visits' plan; not the
constants, the days and the noise. The mean of the true returns given the data is approximated by a regression over many patients of that
kind, on each of which the same visits are run: a Gaussian process on what sessions showed (amortised inference, as in Cranmer, Brehmer and
Louppe 2020). Nothing here may enter an estimator: it knows the simulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ml.outcomes import PREDICTED
from ml.policies.policy import ConstantPolicy, Policy
from ml.population.virtual import World
from ml.population.virtual.patient import MECHANISMS, Patient, draw_patient
from ml.population.virtual.sessions import new_days, simulate
from ml.population.virtual.traits import with_trait
from ml.population.virtual.world import DataDesign, DataSession, visit_plan

Floats = NDArray[np.float64]

KEYS = 1 << 30
"""First key of the random streams of patients besides a world's own."""
DATA_SESSIONS, CALIBRATION = 1 << 40, 1 << 42
"""Session numbers of the data, as the world's own; of the sessions that a threshold is taken from."""
CALIBRATION_DAYS = 10

BINS = 12
"""Random sessions are distinguished by mean amplitude into so many bins at most."""
LAGS = (0, 1, 3, 10, 30)
"""Steps after a change of amplitude at which beta is looked at."""
LARGEST = 4.0
"""Standardised statistics are cut here."""

RBF_SHARES, LENGTHS, NOISES = (0.0, 0.3, 0.7, 1.0), (0.7, 1.5, 3.0), (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Grid of the regression: share of the curved kernel, its length (in roots of the number of statistics), noise over signal."""


def patient_alike(w: World, number: int) -> World:
    """Draw a world of the same kind with other constants: the same mechanism, trait and threshold, days and noise of its own."""
    rng = np.random.default_rng([w.key, number, 0x1DEA])
    patient = with_trait(draw_patient(MECHANISMS.index(w.patient.mechanism), rng), w.trait, rng)
    key = KEYS + 4096 * w.key + number
    return replace(w, patient=_with_threshold(patient._replace(unit=1.0), key, w.settings.xi_beta), key=key)


def _with_threshold(patient: Patient, key: int, xi: float) -> Patient:
    """Scale the patient to the unit of beta at which the threshold midway between cDBS and 0.3 is xi."""
    days = new_days(key, CALIBRATION, CALIBRATION_DAYS)
    full, low = (simulate(patient, 1.0, ConstantPolicy(a), days=days, key=key, first=CALIBRATION).beta.mean() for a in (1.0, 0.3))
    return patient._replace(unit=float(2 * xi / (full + low)))


def returns_of(w: World, policies: Sequence[Policy], sessions: int) -> Floats:
    """Compute true returns [P, sessions] on new days; session i of two policies has the same day and noise."""
    return np.stack([w.truth(policy, sessions).returns for policy in policies])


def statistics(w: World, design: DataDesign, visits: int) -> Floats:
    """Compute what the sessions of early visits show, [k], the same numbers in the same order for every patient."""
    rows = visit_plan(w.settings, design, 0, visits)
    longest = max(row.amplitudes.size for row in rows)
    shortest = min(row.amplitudes.size for row in rows)
    amplitudes = np.stack([np.pad(row.amplitudes, (0, longest - row.amplitudes.size)) for row in rows])
    days = w.data_days(rows, 0)
    long = w.run(amplitudes, days, DATA_SESSIONS, longest)
    # sessions of two lengths: the beginning of a longer one is the shorter one, but not what is measured at its end
    short = w.run(amplitudes[:, :shortest], days, DATA_SESSIONS, shortest)
    ends_early = np.array([row.amplitudes.size == shortest for row in rows])
    above, log_beta = long.beta >= w.settings.xi_beta, np.log(np.maximum(long.beta, 1e-6))
    each = []
    for i, row in enumerate(rows):
        n = row.amplitudes.size
        run = short if ends_early[i] else long
        shares = (above[i, :n].mean(), above[i, : n // 3].mean(), above[i, 2 * n // 3 : n].mean(), log_beta[i, :n].mean())
        each.append([*shares, *(run.qocs[o.field][i] / p.percent for o, p in PREDICTED)])
    return np.concatenate([_by_bin(rows, np.array(each)), _answers(rows, log_beta)])


def _by_bin(rows: Sequence[DataSession], each: Floats) -> Floats:
    """Average over the cDBS sessions, those without stimulation, and random ones of like mean amplitude, flat."""
    kinds = np.array([row.controller for row in rows])
    doses = np.array([row.amplitudes.mean() for row in rows])
    random = np.flatnonzero(kinds == "random")
    random = random[np.argsort(doses[random], kind="stable")]
    groups = [np.flatnonzero(kinds == kind) for kind in ("cdbs", "no_dbs")] + np.array_split(random, min(BINS, random.size))
    return np.concatenate([each[g].mean(0) for g in groups])


def _answers(rows: Sequence[DataSession], log_beta: Floats) -> Floats:
    """Compute the covariance of beta with the amplitude some steps before, within the random sessions, over the amplitude's variance,
    [LAGS]."""
    found = np.zeros(len(LAGS))
    total = 0.0
    for i, row in enumerate(rows):
        if row.controller != "random":
            continue
        a = row.amplitudes - row.amplitudes.mean()
        y = log_beta[i, : a.size] - log_beta[i, : a.size].mean()
        total += float(a @ a)
        found += [float(a[: a.size - lag] @ y[lag:]) for lag in LAGS]
    return found / max(total, 1e-9)


@dataclass(frozen=True)
class Regression:
    """A Gaussian process from statistics to several targets, one kernel for all.

    Attributes:
        centre, spread: of the statistics, [k]. points: standardised, [N, k]. rbf_share, length, noise: of the kernel.
        mean: of the targets, [C]. weights: K^-1 (y - mean), [N, C]. left_out: prediction of every patient from all others, [N, C].
    """

    centre: Floats
    spread: Floats
    points: Floats
    rbf_share: float
    length: float
    noise: float
    mean: Floats
    weights: Floats
    left_out: Floats

    def predict(self, statistics: Floats) -> Floats:
        """Predict the mean of the targets [..., C] given statistics [..., k]."""
        x = standardised(np.atleast_2d(statistics), self.centre, self.spread)
        found = self.mean + kernel(x, self.points, self.rbf_share, self.length) @ self.weights
        return np.asarray(found[0] if statistics.ndim == 1 else found)


def regress(statistics: Floats, targets: Floats) -> Regression:
    """Fit to N patients: statistics [N, k], targets [N, C]; the kernel at its largest marginal likelihood over a grid."""
    centre, spread = statistics.mean(0), statistics.std(0)
    spread = np.where(spread > 1e-9, spread, 1.0)
    x, mean = standardised(statistics, centre, spread), targets.mean(0)
    y = targets - mean
    best, chosen = -np.inf, (0.0, 1.0, 1.0)
    for share, length in product(RBF_SHARES, LENGTHS):
        if share == 0.0 and length != LENGTHS[0]:
            continue
        values, vectors = np.linalg.eigh(kernel(x, x, share, length))
        rotated = vectors.T @ y
        for noise in NOISES:
            d = np.maximum(values, 0.0) + noise
            fit = float(-0.5 * len(y) * np.log((rotated**2 / d[:, None]).sum(0)).mean() - 0.5 * np.log(d).sum())
            if fit > best:
                best, chosen = fit, (share, length, noise)
    share, length, noise = chosen
    inverse = np.linalg.inv(kernel(x, x, share, length) + noise * np.eye(len(x)))
    weights = inverse @ y
    return Regression(centre, spread, x, share, length, noise, mean, weights, targets - weights / np.diag(inverse)[:, None])


def standardised(statistics: Floats, centre: Floats, spread: Floats) -> Floats:
    """Express statistics in standard deviations, cut at `LARGEST`."""
    return np.asarray(np.clip((statistics - centre) / spread, -LARGEST, LARGEST), dtype=np.float64)


def kernel(a: Floats, b: Floats, rbf_share: float, length: float) -> Floats:
    """Compute the straight and curved similarity of standardised statistics, [A, B]."""
    k = a.shape[1]
    straight = a @ b.T / k
    squared = np.maximum((a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T, 0.0)
    return np.asarray((1 - rbf_share) * straight + rbf_share * np.exp(-0.5 * squared / (length**2 * k)), dtype=np.float64)


@dataclass(frozen=True)
class Observed:
    """Predictions of an observer with so many visits, of a world and of others of its kind.

    Attributes:
        `said`: of the world itself, [C]. others: of patients that it did not learn from, [T, C].
        error: standard deviation of what is left open about a return, by candidate, less the scatter of simulated returns, [C].
    """

    said: Floats
    others: Floats
    error: Floats


def observe(
    w: World, design: DataDesign, visits: int, learnt: Sequence[World], targets: Floats, scatter: Floats, others: Sequence[World]
) -> Observed:
    """Fit the observer of a world.

    Args:
        w: the world. design, visits: of its data, 0 for none. learnt: patients of its kind, N. targets: their simulated returns, [N, C].
        scatter: error variance of these, on average, [C]. others: patients to be judged besides w.
    """
    if visits == 0:
        mean = targets.mean(0)
        return Observed(mean, np.tile(mean, (len(others), 1)), np.sqrt(np.maximum(targets.var(0, ddof=1) - scatter, 0.0)))
    fitted = regress(np.stack([statistics(p, design, visits) for p in learnt]), targets)
    left = ((targets - fitted.left_out) ** 2).mean(0) - scatter
    tested = np.stack([statistics(p, design, visits) for p in others]) if others else np.zeros((0, fitted.centre.size))
    predicted = fitted.predict(tested) if others else np.zeros((0, targets.shape[1]))
    return Observed(fitted.predict(statistics(w, design, visits)), predicted, np.sqrt(np.maximum(left, 0.0)))


__all__ = ["Observed", "observe", "patient_alike", "regress", "returns_of", "statistics"]
