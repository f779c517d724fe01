"""Response of beta to the amplitude: an impulse response behind a dose shape, averaged over shapes and time scales.

    y_t = mu + visit + session + sum over k of g_k f(a_{t-k}) + eta_t,    eta_t = sum over l <= W of phi_l eta_{t-l} + e_t

y is standardised (log) beta, f one of `SHAPES` with f(0) = 0 and f(1) = 1 (a Hammerstein model). The impulse response g is constant over
each of `EDGES`' stretches of lags. It has the stable-spline prior of first order, cov(g_i, g_j) = c alpha^max(i, j) (Pillonetto and De
Nicolao 2010; Chen, Ohlsson and Ljung 2012). So it is smooth and fades with a time constant that alpha states. An immediate answer g_0 of
its own size is added. The marginal likelihood weighs shapes and alphas; none is chosen. Where amplitudes that lasted only briefly cannot
separate a slow answer from none, the draws have both, and the interval of a sustained dose shows it. Levels of visits and sessions are
random effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ml.ope.doses import after_doses, held_amplitude, lead_dose, lead_doses
from ml.ope.estimate import require_two_sessions
from ml.ope.linear.dynamics import autoregression, innovations_of, level_sums, log_noise_weights, split_coefficients, visit_numbers
from ml.ope.scale import Scale
from ml.statistics.mixed import MixedFit, MixedModel
from ml.statistics.nested import SessionSums
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

EDGES = (0, 1, 2, 3, 4, 6, 9, 13, 19, 27, 39, 56, 81, 116, 166)
"""First lag of every stretch of lags over which the impulse response is constant, and the lag at which it ends, steps."""
STRETCHES = len(EDGES) - 1
MEMORY = EDGES[-1]

ALPHAS = (0.5, 0.75, 0.88, 0.94, 0.97, 0.985, 0.993)
"""Decay per step of the prior's variance: time constants of 1.4 to 142 steps."""

SHAPES = ("line", "hill", "threshold", "late")
TURNS = 3
FEWEST_WEIGHT = 1e-3
"""Combinations below this share of the evidence get no draws."""


def dose(shape: str, a: Floats) -> Floats:
    """Compute f(a) of a dose shape for amplitude fractions a; 0 at 0 and 1 at 1."""
    if shape == "line":
        return a
    if shape == "hill":
        return np.asarray(a * 1.3 / (a + 0.3), dtype=np.float64)
    if shape == "threshold":
        low, high = 1 / (1 + np.exp(6.0)), 1 / (1 + np.exp(-6.0))
        return np.asarray((1 / (1 + np.exp(-12.0 * (a - 0.5))) - low) / (high - low), dtype=np.float64)
    if shape == "late":
        return np.asarray(a**3, dtype=np.float64)
    raise ValueError(f"there is no dose shape {shape!r}; there are {', '.join(SHAPES)}")


@cache
def prior_root(alpha: float) -> Floats:
    """Compute R [STRETCHES, STRETCHES + 1] with g = R u, u independent of one variance, where g has the stable-spline prior at `alpha`.

    Columns of the design are means of f over a stretch of lags. A coefficient is then the sum of the impulse response over the stretch. R
    R^T is scaled so that the prior variance of the sustained answer, the sum of g, is 1. The last u is the immediate answer's own, whose
    prior standard deviation is 0.3 of it.
    """
    starts, ends = np.array(EDGES[:-1]), np.array(EDGES[1:])
    lags = np.arange(MEMORY)
    kernel = alpha ** np.maximum(lags[:, None], lags[None, :])
    member = (lags[None, :] >= starts[:, None]) & (lags[None, :] < ends[:, None])
    sums = member.astype(np.float64)
    covariance = sums @ kernel @ sums.T
    covariance /= covariance.sum()
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    immediate = np.zeros((STRETCHES, 1))
    immediate[0] = 0.3
    return np.concatenate([root, immediate], axis=1)


class LaggedMeans:
    """Means of a signal over every stretch of lags, step by step, for rows side by side; before its start it has its first value."""

    def __init__(self, first: Floats, steps: int) -> None:
        self._sums = np.empty((MEMORY + steps + 1, *first.shape))
        self._sums[: MEMORY + 1] = np.arange(MEMORY + 1).reshape(-1, *([1] * first.ndim)) * first
        self._now = MEMORY

    def sums(self, value: Floats) -> Floats:
        """Sum the signal up to every edge, [STRETCHES + 1, ...], with the newest value [...] at lag 0."""
        self._now += 1
        self._sums[self._now] = self._sums[self._now - 1] + value
        return np.asarray(self._sums[self._now - np.array(EDGES)], dtype=np.float64)

    def step(self, value: Floats) -> Floats:
        """Compute means [..., STRETCHES] with the newest value [...] at lag 0."""
        sums = np.moveaxis(self.sums(value), 0, -1)
        return np.asarray((sums[..., :-1] - sums[..., 1:]) / np.diff(EDGES), dtype=np.float64)


def lagged_means(signal: Floats, before: float | None = None) -> Floats:
    """Compute `LaggedMeans` of a whole signal [T] after the value `before` it (its first one where that is None), [T, STRETCHES]."""
    first = signal[0] if before is None else before
    sums = np.concatenate([np.zeros(1), np.cumsum(np.concatenate([np.full(MEMORY, first), signal]))])
    now = MEMORY + 1 + np.arange(signal.size)
    at = now[:, None] - np.array(EDGES)
    return np.asarray((sums[at[:, :-1]] - sums[at[:, 1:]]) / np.diff(EDGES), dtype=np.float64)


@dataclass(frozen=True)
class ResponseTable:
    """One session, standardised: beta [W + T] with the window before it first, amplitude [T], means over stretches of lags by dose shape
    [W + T, STRETCHES], usable steps [T].
    """

    beta: Floats
    amplitude: Floats
    means: dict[str, Floats]
    usable: NDArray[np.bool_]

    @classmethod
    def of(cls, session: SessionTrajectory, scale: Scale, otherwise: float | None = None) -> ResponseTable:
        """Build the tables of a session after the dose before it, which is `otherwise` where no record says it
        (`ml.ope.doses.lead_dose`)."""
        a, window, before = held_amplitude(session), session.lead_beta.size, lead_dose(session, otherwise)
        first = a[0] if before is None else before
        means = {shape: lagged_means(dose(shape, np.concatenate([np.full(window, first), a]))) for shape in SHAPES}
        return cls(scale.beta(session.padded_beta), a, means, session.usable())


@dataclass(frozen=True)
class Combination:
    """One dose shape with one time scale: its share of the evidence and the posterior of its coefficients."""

    shape: str
    alpha: float
    weight: float
    fit: MixedFit


@dataclass(frozen=True)
class ImpulseDynamics:
    """A fitted model, or draws from its posterior; n sessions, D sets of coefficients.

    Attributes:
        phi: autoregression of eta on lags 1 ... W, [W].
        gains: sums of the impulse response over each stretch of lags, [D, STRETCHES].
        shapes: dose shape of each set, [D] indices of `SHAPES`.
        levels: mu + visit + session, [D, n].
        noise_weights: of the log of an innovation's scale on (1, a, predicted beta), [3].
        evidence: share of every (shape, alpha).
        shares: lambda / (1 + lambda) of the visits' and the sessions' levels.
        before: dose before each session, [n]; NaN: its first amplitude.
        ratios: likeliest lambdas of every (shape, alpha).
    """

    phi: Floats
    gains: Floats
    shapes: NDArray[np.int64]
    levels: Floats
    noise_weights: Floats
    evidence: dict[tuple[str, float], float]
    shares: dict[str, float]
    before: Floats
    ratios: dict[tuple[str, float], Floats] = field(default_factory=dict)

    @property
    def sustained(self) -> Floats:
        """Answer of standardised beta to a dose that lasts for ever, from no stimulation to cDBS, [D]."""
        return np.asarray(self.gains.sum(1), dtype=np.float64)

    def rest(self, table: ResponseTable) -> Floats:
        """Compute the part of beta that answers to the amplitude, [D, W + T]."""
        every = np.stack([table.means[shape] for shape in SHAPES])[self.shapes]
        return np.einsum("dtk,dk->dt", every, self.gains)

    def innovations(self, tables: Sequence[ResponseTable]) -> list[Floats]:
        """Compute standardised innovations of the steps of each session, [D, T]; NaN where a step is not usable."""
        found = []
        for i, table in enumerate(tables):
            eta = table.beta - self.rest(table) - self.levels[:, i : i + 1]
            found.append(innovations_of(eta, table.beta, table.amplitude, table.usable, self.phi, self.noise_weights))
        return found

    def usual_lead(self) -> Floats:
        """Compute standardised beta of each session under the mean of the random amplitudes, [n]: where the window before it is not
        known."""
        answer = [float(dose(SHAPES[s], np.array([0.65]))[0]) * g for s, g in zip(self.shapes, self.sustained, strict=True)]
        return np.asarray((self.levels + np.array(answer)[:, None]).mean(0), dtype=np.float64)

    def response(self, first: Floats, steps: int) -> Response:
        """Begin the answer to amplitudes that come step by step, the first of them [P, D, n]."""
        return Response(self, after_doses(first, self.before), steps)


class Response:
    """The answer of beta to amplitudes [P, D, n] as they come."""

    def __init__(self, dynamics: ImpulseDynamics, before: Floats, steps: int) -> None:
        self._dynamics = dynamics
        self._groups = [(SHAPES[s], np.flatnonzero(dynamics.shapes == s)) for s in np.unique(dynamics.shapes)]
        self._means = [LaggedMeans(dose(shape, before[:, members]), steps) for shape, members in self._groups]
        self._before = before
        # an answer is a weighted sum of the signal's sums up to the edges
        each = dynamics.gains / np.diff(EDGES)
        self._weights = np.pad(each, ((0, 0), (0, 1))) - np.pad(each, ((0, 0), (1, 0)))

    def lasting(self) -> Floats:
        """Answer [P, D, n] before the first amplitudes."""
        answer = np.empty_like(self._before)
        for shape, members in self._groups:
            answer[:, members] = dose(shape, self._before[:, members]) * self._dynamics.sustained[members, None]
        return answer

    def step(self, a: Floats) -> Floats:
        """Answer [P, D, n] once the amplitudes a [P, D, n] are in force."""
        answer = np.empty_like(a)
        for (shape, members), means in zip(self._groups, self._means, strict=True):
            answer[:, members] = np.einsum("kpdn,dk->pdn", means.sums(dose(shape, a[:, members])), self._weights[members])
        return answer


def fit_impulse(
    buffer: ReplayBuffer, tables: Sequence[ResponseTable], draws: int, seed: int, otherwise: float | None = None
) -> ImpulseDynamics:
    """Draw sets of coefficients (`draws`) from the posterior over shapes, time scales and coefficients.

    Args:
        otherwise: the dose before sessions of which no record says it, as the tables were made with.

    Raises:
        ValueError: fewer than two sessions with usable steps.
    """
    require_two_sessions("the response model", sum(bool(t.usable.any()) for t in tables))
    window, visit = buffer.settings.window, visit_numbers(buffer)
    phi = np.zeros(window)
    best: Combination | None = None
    for turn in range(TURNS):
        candidates = ALPHAS if turn == 0 else _beside(best)
        found = _weighed(tables, visit, phi, SHAPES[:1] if turn == 0 else SHAPES[:2], candidates)
        best = max(found, key=lambda c: c.weight)
        residual = _residuals(tables, best, visit)
        phi = autoregression(residual, [t.usable for t in tables], window)
    combinations = _weighed(tables, visit, phi, SHAPES, ALPHAS)
    best = max(combinations, key=lambda c: c.weight)
    noise = log_noise_weights(
        _residuals(tables, best, visit), [t.beta for t in tables], [t.amplitude for t in tables], [t.usable for t in tables], phi
    )  # fmt: skip
    return _drawn(combinations, visit, phi, noise, lead_doses(buffer.sessions, otherwise), draws, seed)


def _beside(best: Combination | None) -> tuple[float, ...]:
    k = ALPHAS.index(best.alpha) if best else 0
    return ALPHAS[max(0, k - 1) : k + 2]


def _weighed(
    tables: Sequence[ResponseTable], visit: Indices, phi: Floats, shapes: Sequence[str], alphas: Sequence[float]
) -> list[Combination]:
    found: list[tuple[str, float, MixedFit]] = []
    for shape in shapes:
        sums = response_sums(tables, visit, phi, shape)
        found += [(shape, alpha, RESPONSE_MODEL.fit(moved(sums, alpha))) for alpha in alphas]
    logs = np.array([fit.log_evidence for _, _, fit in found])
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    return [Combination(s, a, float(w), f) for (s, a, f), w in zip(found, weights, strict=True)]


def response_sums(tables: Sequence[ResponseTable], visit: Indices, phi: Floats, shape: str) -> SessionSums:
    """Collect the sums of every session over rows filtered by phi; columns: 1, means over stretches of lags."""
    return level_sums([t.beta for t in tables], [t.means[shape] for t in tables], [t.usable for t in tables], visit, phi)


def moved(sums: SessionSums, alpha: float) -> SessionSums:
    """Convert sums to the columns (1, u), of which `prior_root` makes the impulse response."""
    root = prior_root(alpha)
    change = np.zeros((1 + STRETCHES, 1 + root.shape[1]))
    change[0, 0], change[1:, 1:] = 1.0, root
    return sums.changed(change)


RESPONSE_MODEL = MixedModel(STRETCHES + 2, {"response": range(1, 2 + STRETCHES)}, {})
"""The mixed model of the columns (1, u)."""


def _split(coefficients: Floats, visit: Indices, alpha: float) -> tuple[Floats, Floats]:
    """Compute gains [D, STRETCHES] and levels [D, n] from coefficients [D, p]."""
    root = prior_root(alpha)
    answers, levels = split_coefficients(coefficients, visit, root.shape[1])
    return answers @ root.T, levels


def _residuals(tables: Sequence[ResponseTable], chosen: Combination, visit: Indices) -> list[Floats]:
    """Compute eta [W + T] of every session at the posterior mean of a combination."""
    gains, levels = _split(chosen.fit.coefficients[None], visit, chosen.alpha)
    return [table.beta - table.means[chosen.shape] @ gains[0] - levels[0, i] for i, table in enumerate(tables)]


def _drawn(
    combinations: Sequence[Combination], visit: Indices, phi: Floats, noise: Floats, before: Floats, draws: int, seed: int
) -> ImpulseDynamics:
    """Share the draws out over the combinations by their evidence (largest remainders, so that a rare one is not a matter of luck)."""
    live = [c for c in combinations if c.weight >= FEWEST_WEIGHT]
    shares = np.array([c.weight for c in live]) / sum(c.weight for c in live) * draws
    counts = np.floor(shares).astype(int)
    for k in np.argsort(shares - counts)[::-1][: draws - counts.sum()]:
        counts[k] += 1
    rng = np.random.default_rng([seed, 0x1A7])
    gains, levels, shapes = [], [], []
    for combination, count in zip(live, counts, strict=True):
        if count:
            g, own = _split(combination.fit.draws(int(count), rng), visit, combination.alpha)
            gains.append(g)
            levels.append(own)
            shapes += [SHAPES.index(combination.shape)] * int(count)
    shares_of = {name: sum(c.weight * c.fit.share(name) for c in combinations) for name in ("visit", "session")}
    evidence = {(c.shape, c.alpha): c.weight for c in combinations}
    ratios = {(c.shape, c.alpha): c.fit.likeliest for c in combinations}
    return ImpulseDynamics(phi, np.concatenate(gains), np.array(shapes), np.concatenate(levels), noise, evidence, shares_of, before, ratios)
