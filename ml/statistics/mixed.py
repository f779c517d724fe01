"""Linear mixed model with a posterior over its variance components: y = W c + e, groups of coefficients c_g ~ N(0, lambda_g sigma^2).

Each group (visits' levels, sessions' levels, curvature) is shrunk as far as the data ask for. What they leave open about that is averaged
over. The likeliest value alone would often be zero in a dozen sessions. Sources: Henderson's mixed model equations and the restricted
likelihood as in Searle, Casella and McCulloch 1992, chapters 6 and 7. The prior of a group's standard deviation over that of the noise is
the half-Cauchy of scale 1 (Gelman 2006; Polson and Scott 2012).

Everything follows from sums over rows (W^T W, W^T y, y^T y): rows are read once. Columns cost: with q of them a point of the lambdas' grid
takes q^3 operations and q^2 numbers. Levels of sessions and visits are not among the q: `ml.statistics.nested` eliminates them first, which
takes q^2 operations per session.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ml.statistics.nested import Reduced, SessionSums

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

SMALLEST_SQUARES = 1e-12
"""Sum of squares below which a column is one of zeros. Columns have no unit: indicators, and amplitudes as fractions of cDBS."""

PERFECT = 1e-12
"""Share of the sum of y^2 that a perfect fit leaves: y may have any unit."""

RIDGE = 1e-10
"""Penalty of columns that are not shrunk, as a share of the trace of the Gram matrix."""

SMALLEST, LARGEST = 1e-6, 1e3
"""Bounds of every lambda."""

COARSE = tuple(float(v) for v in 10.0 ** np.arange(-5.0, 2.5, 0.5))
"""Values of one lambda that the search for the likeliest point tries in turn."""

FINE = tuple(float(v) for v in 10.0 ** np.arange(-0.5, 0.55, 0.1))
"""Multiples of them that it tries next."""

FINER = tuple(10.0 ** (np.linspace(-1, 1, 9)[None] * np.array([[0.1], [0.03], [0.01], [0.003]])))
"""Multiples that a fit at one point tries after these, ever closer. The square root of a lambda is then found to half a per cent."""

STEPS = (1.2, 1.5, 2.0, 3.0, 5.0, 8.0)
"""Ratios between neighbouring lambdas of the grid that the posterior is averaged over. The first is taken at which the log posterior has
fallen by a half on average; the grid then covers what the data leave open.
"""


def live_columns(diagonal: Floats) -> NDArray[np.bool_]:
    """Find columns that are not zero, for their sums of squares [..., q]."""
    return np.asarray(diagonal > SMALLEST_SQUARES)


@dataclass(frozen=True)
class Sums:
    """Sums over the rows, all that a fit needs of them: gram W^T W [q, q], moment W^T y [q], square y^T y, number of rows."""

    levels: ClassVar[tuple[str, ...]] = ()

    gram: Floats
    moment: Floats
    square: float
    number: int

    @classmethod
    def of(cls, design: Floats, y: Floats) -> Sums:
        """Sum over the rows of a design [n, q] and targets [n]."""
        return cls(design.T @ design, design.T @ y, float(y @ y), len(y))

    @property
    def diagonal(self) -> Floats:
        """Sums of squares of the columns, [q]."""
        return np.diagonal(self.gram)

    @property
    def trace(self) -> float:
        """Of the Gram matrix."""
        return float(np.trace(self.gram))

    def take(self, columns: Indices) -> Sums:
        """Select the sums of some columns."""
        return replace(self, gram=self.gram[np.ix_(columns, columns)], moment=self.moment[columns])

    def means(self, at: Reduced, columns: Floats) -> tuple[Floats, ...]:
        """Return the levels given the columns' coefficients: there is none."""
        return ()

    def spread(self, at: Reduced, penalties: Floats, noise: Floats) -> Floats:
        """Multiply L^-T by noise [K, R, q], where L L^T are the equations with penalties [K, q]."""
        q = penalties.shape[1]
        lower = np.linalg.cholesky(at.joint[:, :q, :q] + penalties[:, :, None] * np.eye(q))
        return np.asarray(noise @ np.linalg.inv(lower), dtype=np.float64)

    def reduced(self, ratios: Floats) -> Reduced:
        """Return the equations, K times for ratios [K, 0]: there is no level to eliminate."""
        whole = np.block([[self.gram, self.moment[:, None]], [self.moment, np.full((1, 1), self.square)]])
        k = len(ratios)
        return Reduced(np.broadcast_to(whole, (k, *whole.shape)), np.zeros(k), np.zeros((k, 0, len(whole))), ratios, np.zeros((k, 0)))


@dataclass(frozen=True)
class MixedModel:
    """Grouping of the columns of a mixed model.

    Attributes:
        columns: q, without those of the levels of `SessionSums`, which follow them: those of the visits, then those of the sessions.
        estimated: columns of each group whose lambda is estimated; the levels of `SessionSums` are two more groups, the last ones.
        known: lambda of columns that have a stated one (weak priors). Columns in neither are not shrunk.
    """

    columns: int
    estimated: Mapping[str, Sequence[int]]
    known: Mapping[int, float]

    def fit(self, sums: Sums | SessionSums) -> MixedFit:
        """Compute the posterior by the restricted likelihood.

        Raises:
            ValueError: no row.
        """
        problem = _Problem(self, sums)
        names = [*self.estimated, *sums.levels]
        best = problem.search()
        # Five values of each lambda, or three wider apart where four groups would make too many combinations. From six groups on the two
        # at one standard deviation, which keep its mean and its variance (Gauss and Hermite's rule of two points).
        powers = np.arange(-2.0, 3.0) if len(names) < 4 else np.array([-1.7, 0.0, 1.7]) if len(names) < 6 else np.array([-1.0, 1.0])
        axes = [np.clip(v * step**powers, SMALLEST, LARGEST) for v, step in zip(best, problem.steps(best), strict=True)]
        points = sorted(set(product(*[axis.tolist() for axis in axes])))
        ratios = np.array(points, dtype=np.float64).reshape(len(points), len(names))
        logs, means, _, squares = problem.solve(ratios)
        weights = np.exp(logs - logs.max())
        # every point represents a cell of the grid, whose volume in log lambda is the product of its axes' spacings
        cell = float(np.sum([np.log(max(np.log(axis.max() / axis.min()), 1e-9) / max(len(np.unique(axis)) - 1, 1)) for axis in axes]))
        log_evidence = float(logs.max() + np.log(weights.sum()) + cell)
        weights /= weights.sum()
        return MixedFit(tuple(names), best, ratios, weights, means, squares, problem.degrees, log_evidence, problem)

    def restricted(self, sums: Sums) -> RestrictedFit:
        """Estimate the coefficients and their covariance at the lambdas of the largest restricted likelihood, without a prior of them.

        Raises:
            ValueError: no row.
        """
        problem = _Problem(self, sums, prior=False)
        best = problem.refined(problem.search())
        _, means, factors, squares = problem.solve(best[None])
        variance = float(squares[0]) / problem.degrees
        degrees = problem.satterthwaite(best, variance)
        return RestrictedFit(tuple(self.estimated), best, means[0], variance * factors[0] @ factors[0].T, variance, degrees)

    def likeliest(self, sums: Sums | SessionSums) -> tuple[Floats, Floats]:
        """Find the likeliest lambdas [G] and all coefficients there: `fit` without what the data leave open.

        Raises:
            ValueError: no row.
        """
        problem = _Problem(self, sums)
        best = problem.search()
        return best, problem.solve(best[None])[1][0]


@dataclass(frozen=True)
class MixedFit:
    """Posterior of a mixed model: a mixture over K combinations of lambdas; p coefficients, those of levels among them.

    Attributes:
        groups: names of the estimated groups, G. likeliest: their lambdas at the likeliest point, [G].
        ratios: lambdas, [K, G]. weights: posterior weight of each combination, [K].
        means: coefficients, [K, p].
        squares: residual sum of squares with its penalty, [K]. degrees: of freedom.
        log_evidence: log of the restricted likelihood averaged over the lambdas' prior, up to a constant that is the same for designs of
            the same rows and the same columns that are not shrunk.
        problem: the equations, for draws.
    """

    groups: tuple[str, ...]
    likeliest: Floats
    ratios: Floats
    weights: Floats
    means: Floats
    squares: Floats
    degrees: int
    log_evidence: float
    problem: _Problem = field(repr=False)

    @property
    def coefficients(self) -> Floats:
        """Posterior mean, [p]."""
        return np.asarray(self.weights @ self.means, dtype=np.float64)

    @property
    def covariance(self) -> Floats:
        """Posterior covariance of the coefficients, [p, p]; makes K matrices of that size."""
        scale = self.weights * self.squares / max(self.degrees - 2, 1)
        k, p = self.means.shape
        turned = self.problem.spread(self.ratios, np.broadcast_to(np.eye(p), (k, p, p)))
        inside = np.einsum("k,kji,kjl->il", scale, turned, turned)
        apart = self.means - self.coefficients
        return np.asarray(inside + np.einsum("k,ki,kj->ij", self.weights, apart, apart), dtype=np.float64)

    def share(self, group: str) -> float:
        """Return the posterior mean of lambda / (1 + lambda): a level's share of the variance of one row."""
        values = self.ratios[:, self.groups.index(group)]
        return float(self.weights @ (values / (1 + values)))

    def draws(self, number: int, rng: np.random.Generator) -> Floats:
        """Draw coefficients from the posterior, [number, p]."""
        k = rng.choice(len(self.weights), number, p=self.weights)
        # A variance of one degree of freedom has no mean; what is drawn is cut to what can be averaged.
        sigma = np.sqrt(self.squares[k] / np.maximum(rng.chisquare(self.degrees, number), 0.05 * self.degrees))
        noise = rng.standard_normal((number, self.means.shape[1]))
        # draws of one combination side by side, so that its equations are solved once
        points, place, counts = np.unique(k, return_inverse=True, return_counts=True)
        slot = np.empty(number, dtype=np.int64)
        slot[np.argsort(place, kind="stable")] = np.concatenate([np.arange(count) for count in counts])
        grouped = np.zeros((len(points), counts.max(), noise.shape[1]))
        grouped[place, slot] = noise
        spread = self.problem.spread(self.ratios[points], grouped)[place, slot]
        return np.asarray(self.means[k] + sigma[:, None] * spread, dtype=np.float64)


@dataclass(frozen=True)
class RestrictedFit:
    """Fit at the largest restricted likelihood.

    Attributes:
        groups: names of the estimated groups, G. ratios: their lambdas, [G]; at the lower end of the grid where the data show no such
            variance.
        coefficients: [q]. covariance: of them given the lambdas, [q, q]. variance: sigma^2.
        degrees: of freedom of every coefficient's variance by Satterthwaite's approximation, [q]; inf where the data leave it none.
    """

    groups: tuple[str, ...]
    ratios: Floats
    coefficients: Floats
    covariance: Floats
    variance: float
    degrees: Floats


class _Problem:
    """The equations of one data set, over the columns that vary at all.

    Raises:
        ValueError: no row.
    """

    def __init__(self, model: MixedModel, sums: Sums | SessionSums, *, prior: bool = True) -> None:
        if sums.number < 1:
            raise ValueError("a mixed model needs at least one row")
        self.q, self.prior = model.columns, prior
        # A column of zeros says nothing: its coefficient stays 0 and it counts in no likelihood.
        self.live = np.flatnonzero(live_columns(sums.diagonal))
        place = {int(c): j for j, c in enumerate(self.live)}
        self.sums = sums.take(self.live)
        self.groups = [[place[c] for c in columns if c in place] for columns in model.estimated.values()]
        self.known = {place[c]: v for c, v in model.known.items() if c in place}
        free = len(self.live) - sum(map(len, self.groups)) - len(self.known)
        self.degrees = max(sums.number - free, 1)
        self.floor = PERFECT * sums.square or float(np.finfo(np.float64).tiny)
        self.fixed = np.full(len(self.live), RIDGE * self.sums.trace or 1.0)
        for column, ratio in self.known.items():
            self.fixed[column] = 1 / ratio

    def log_posterior(self, ratios: Floats) -> Floats:
        """Log posterior of the lambdas [K, G], [K], up to a constant: `solve` without what the search does not need.

        The last diagonal element of the Cholesky factor of [[A, m], [m^T, y^T y]] is the root of y^T y - m^T A^-1 m.
        """
        q = len(self.live)
        joint, log_det = self._without_levels(ratios)
        joint = joint + np.eye(q + 1) * np.append(self._penalties(ratios), np.full((len(ratios), 1), self.floor), axis=1)[:, None, :]
        # a little more than y^T y keeps the matrix positive definite where the fit is perfect
        diagonal = np.diagonal(np.linalg.cholesky(joint), axis1=1, axis2=2)
        return self._logs(ratios, diagonal[:, :q], np.maximum(diagonal[:, q] ** 2 - self.floor, self.floor), log_det)

    def solve(self, ratios: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Log posterior of the lambdas [K] (up to a constant), all coefficients [K, p], factors of the columns [K, q, q], squares [K] at
        lambdas [K, G].
        """
        q, k = len(self.live), len(ratios)
        at = self.sums.reduced(ratios[:, len(self.groups) :])
        lower = np.linalg.cholesky(at.joint[:, :q, :q] + self._penalties(ratios)[:, :, None] * np.eye(q))
        inverse = np.linalg.inv(lower)
        half = (inverse @ at.joint[:, :q, q:])[..., 0]
        squares = np.maximum(at.joint[:, q, q] - np.sum(half**2, axis=1), self.floor)
        logs = self._logs(ratios, np.diagonal(lower, axis1=1, axis2=2), squares, at.log_det)
        columns, means, factors = np.einsum("kji,kj->ki", inverse, half), np.zeros((k, self.q)), np.zeros((k, self.q, self.q))
        means[:, self.live] = columns
        factors[:, self.live[:, None], self.live] = np.swapaxes(inverse, 1, 2)
        return logs, np.concatenate([means, *self.sums.means(at, columns)], axis=1), factors, squares

    def spread(self, ratios: Floats, noise: Floats) -> Floats:
        """Turn noise [K, R, p] into deviations of the coefficients over sigma, [K, R, p], at lambdas [K, G]."""
        found, kept = np.zeros(noise.shape), np.append(self.live, np.arange(self.q, noise.shape[2]))
        at = self.sums.reduced(ratios[:, len(self.groups) :])
        found[:, :, kept] = self.sums.spread(at, self._penalties(ratios), noise[:, :, kept])
        return found

    def _without_levels(self, ratios: Floats) -> tuple[Floats, Floats]:
        """Return equations [K, q + 1, q + 1] and log determinants [K] of what was eliminated, for lambdas [K, G]: few pairs of levels
        differ.
        """
        pairs, place = np.unique(ratios[:, len(self.groups) :], axis=0, return_inverse=True)
        at = self.sums.reduced(pairs)
        return at.joint[place], at.log_det[place]

    def _penalties(self, ratios: Floats) -> Floats:
        penalties = np.tile(self.fixed, (len(ratios), 1))
        for g, columns in enumerate(self.groups):
            penalties[:, columns] = 1 / ratios[:, g : g + 1]
        return penalties

    def _logs(self, ratios: Floats, diagonal: Floats, squares: Floats, eliminated: Floats) -> Floats:
        counts = np.array([len(columns) for columns in self.groups], dtype=np.float64)
        log_det = 2 * np.log(diagonal).sum(1) + np.log(ratios[:, : len(counts)]) @ counts + eliminated
        # In log lambda the half-Cauchy of sqrt(lambda) has the density sqrt(lambda) / (1 + lambda).
        prior = (0.5 * np.log(ratios) - np.log1p(ratios)).sum(1) if self.prior else 0.0
        return np.asarray(prior - 0.5 * (log_det + self.degrees * np.log(squares)), dtype=np.float64)

    def search(self) -> Floats:
        """Search the likeliest lambdas [G], one coordinate at a time, first over decades, then around the best ones."""
        groups = len(self.groups) + len(self.sums.levels)
        best = np.full(groups, 0.1)
        for _ in range(6):
            before = best.copy()
            for g in range(groups):
                best[g] = self._along(best, g, np.array(COARSE))
            if np.array_equal(before, best):
                break
        for _ in range(2):
            for g in range(groups):
                best[g] = self._along(best, g, np.clip(best[g] * np.array(FINE), SMALLEST, LARGEST))
        return best

    def refined(self, best: Floats) -> Floats:
        """Find the likeliest lambdas [G] near those of the search, which are on a grid."""
        best = best.copy()
        for multiples in FINER:
            for _ in range(3):  # one coordinate at a time: what one gains another gives up
                for g in range(best.size):
                    best[g] = self._along(best, g, np.clip(best[g] * multiples, SMALLEST, LARGEST))
        return best

    def satterthwaite(self, best: Floats, variance: float) -> Floats:
        """Compute the degrees of freedom of the coefficients' variances, [q], at the largest restricted likelihood (Satterthwaite 1946;
        Giesbrecht and Burns 1985).

        2 over the variance of the logarithm of a coefficient's variance, which has that of log lambda and log sigma^2 from the curvature of
        the likelihood. Groups without a variance of their own are ignored, as in lmerTest (Kuznetsova, Brockhoff and Christensen 2017).
        """
        active = [g for g, columns in enumerate(self.groups) if columns and 1e2 * SMALLEST < best[g] < LARGEST]
        n, step = len(active) + 1, 1e-2
        moves = [np.array(m) for m in product((-1, 0, 1), repeat=n)]
        ratios = np.tile(best, (len(moves), 1))
        ratios[:, active] *= np.exp(step * np.array(moves)[:, :-1])
        logs, _, factors, squares = self.solve(ratios)
        sigma2 = variance * np.exp(step * np.array(moves)[:, -1])
        # the likelihood where sigma^2 follows from the lambdas, less what another sigma^2 costs
        logs += 0.5 * self.degrees * (np.log(squares / (self.degrees * sigma2)) + 1) - 0.5 * squares / sigma2
        place, unit = {tuple(m): i for i, m in enumerate(moves)}, np.eye(n, dtype=int)

        def second(i: int, k: int) -> float:
            plus, minus = unit[i] + unit[k], unit[i] - unit[k]
            if i == k:
                return float(logs[place[tuple(unit[i])]] + logs[place[tuple(-unit[i])]] - 2 * logs[place[(0,) * n]])
            return float(sum(s * (logs[place[tuple(m)]] + logs[place[tuple(-m)]]) for m, s in ((plus, 0.25), (minus, -0.25))))

        information = -np.array([[second(i, k) for k in range(n)] for i in range(n)]) / step**2
        if np.linalg.eigvalsh(information)[0] <= 1e-9:
            return np.ones(self.q)  # the likelihood has no top here: nothing is known of the spread
        variances = np.maximum(np.einsum("kij,kij->ki", factors, factors), 1e-300) * sigma2[:, None]
        slope = np.array([np.log(variances[place[tuple(u)]] / variances[place[tuple(-u)]]) for u in unit]) / (2 * step)
        slope[:, np.diagonal(factors[0] @ factors[0].T) == 0] = 0.0
        spread = np.einsum("iq,ij,jq->q", slope, np.linalg.inv(information), slope)
        return np.asarray(np.divide(2.0, spread, out=np.full(self.q, np.inf), where=spread > 0))

    def steps(self, best: Floats) -> list[float]:
        """Choose the ratio between neighbouring lambdas of the grid, per group."""
        top = self.log_posterior(best[None])[0]
        found = []
        for g in range(len(best)):
            trial = np.tile(best, (2 * len(STEPS), 1))
            trial[:, g] = np.clip(best[g] * np.concatenate([STEPS, 1 / np.array(STEPS)]), SMALLEST, LARGEST)
            fall = (top - self.log_posterior(trial)).reshape(2, -1).mean(0)
            found.append(next((s for s, f in zip(STEPS, fall, strict=True) if f >= 0.5), STEPS[-1]))
        return found

    def _along(self, best: Floats, g: int, values: Floats) -> float:
        trial = np.tile(best, (len(values), 1))
        trial[:, g] = values
        return float(values[int(np.argmax(self.log_posterior(trial)))])
