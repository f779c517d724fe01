"""Response of beta to the amplitude as low-passes of several speeds behind dose functions, shrunk as far as the data ask for.

    y_t = mu + visit + session + sum over j, m of g_jm L_m[p_j(a)]_t + sum over k of h_k U_k[a]_t + sum over k of r_k F_k[a]_t + eta_t
    eta_t = sum over l <= W of phi_l eta_{t-l} + e_t

y is standardised (log) beta, p_j one of `dose_functions`, L_m a first-order low-pass with one of `TIMES` (the first of them passes
everything). U_k is a low-pass that rises and falls at different speeds. F_k is one of falls of the amplitude, after which beta may rebound:
a controller that switches often may do worse than any dose that it switches between. Sums of exponentials are a dense family of impulse
responses (Laguerre and Kautz bases: Wahlberg 1991). An answer at once, one over minutes, one that wears off and one that rings are all in
it. The dose may have another shape at every speed. Coefficients of one group share a variance (`ml.statistics.mixed`). The groups are the
straight dose at fast and at slow speeds, the bend of the dose, the difference between rising and falling, and falls. What the data leave
open about them stays in the draws.

Before its first step a session has been under the dose that was in force before it, on record or inferred (`ml.ope.lead`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
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

TIMES = (0.0, 3.0, 8.0, 20.0, 60.0, 180.0)
"""Time constants of the low-passes, steps; 0 passes everything at once."""
KEEP = np.array([np.exp(-1 / t) if t > 0 else 0.0 for t in TIMES])
SLOW = 3
"""From this time on an answer counts as slow."""

BENDS = (0.25, 0.5, 0.75)
"""Amplitude fractions at which a dose function rises from nearly none to nearly all."""
STEEPNESS = 12.0
SHAPES = 1 + len(BENDS)
ONE_SIDED = ((12.0, 80.0), (40.0, 240.0))
"""Time constants of rise and fall of the low-passes that have two, steps."""
RISE, FALL = (1 - np.exp(-1 / np.array(t)) for t in zip(*ONE_SIDED, strict=True))

FALL_TIMES = (4.0, 12.0, 40.0)
"""Time constants of the low-passes of falls, steps."""
FALL_KEEP = np.exp(-1 / np.array(FALL_TIMES))
FALL_UNIT = 5.0
"""Falls enter in fifths of the cDBS amplitude per step: draws of every step fall by 0.1 on average."""

COLUMNS = SHAPES * len(TIMES) + len(ONE_SIDED) + len(FALL_TIMES)
TURNS = 2


def dose_functions(a: Floats) -> Floats:
    """Compute dose functions [..., SHAPES]: the dose itself, and what steep rises at `BENDS` are beyond it, 0 at no stimulation and at
    cDBS.

    Together they make lines, answers that saturate early or late, and ones that turn round.
    """
    found = np.empty((SHAPES, *a.shape))
    found[0] = a
    for k, bend in enumerate(BENDS):
        rise, none, full = (1 / (1 + np.exp(-STEEPNESS * (v - bend))) for v in (a, 0.0, 1.0))
        found[1 + k] = (rise - none) / (full - none) - a
    return np.moveaxis(found, 0, -1)


class Filters:
    """Low-passed doses of rows side by side, at first as if `first` [...] had been on for long."""

    def __init__(self, first: Floats) -> None:
        straight = SHAPES * len(TIMES)
        self.columns = np.zeros((COLUMNS, *first.shape))
        self._passed = self.columns[:straight].reshape(len(TIMES), SHAPES, *first.shape)
        self._sided = self.columns[straight : straight + len(ONE_SIDED)]
        self._falls = self.columns[straight + len(ONE_SIDED) :]
        self._passed[:], self._sided[:], self._now = np.moveaxis(dose_functions(first), -1, 0), first, first

    def step(self, a: Floats) -> Floats:
        """Update `columns`, [COLUMNS, ...], once the amplitudes a [...] are in force; the next step overwrites them."""
        doses = np.moveaxis(dose_functions(a), -1, 0)
        for passed, keep in zip(self._passed, KEEP, strict=True):
            passed *= keep
            passed += (1 - keep) * doses
        for sided, rise, sink in zip(self._sided, RISE, FALL, strict=True):
            gap = a - sided
            sided += np.where(gap > 0, rise, sink) * gap
        fall = FALL_UNIT * np.maximum(self._now - a, 0.0)
        for falls, keep in zip(self._falls, FALL_KEEP, strict=True):
            falls *= keep
            falls += (1 - keep) * fall
        self._now = a
        return self.columns


def columns_of(a: Floats, first: float) -> Floats:
    """Compute `Filters` of a whole session, step by step, [T, COLUMNS], for amplitudes [T] after `first` had been on for long."""
    p, start = dose_functions(a), dose_functions(np.array(first))
    passed = np.empty((a.size, len(TIMES), SHAPES))
    for m, keep in enumerate(KEEP):
        passed[:, m], _ = scipy.signal.lfilter([1 - keep], [1, -keep], p, axis=0, zi=keep * start[None])
    sided = np.empty((a.size, len(ONE_SIDED)))
    now = np.full(len(ONE_SIDED), first)
    for t, value in enumerate(a):
        gap = value - now
        now = now + np.where(gap > 0, RISE, FALL) * gap
        sided[t] = now
    fall = FALL_UNIT * np.maximum(-np.diff(a, prepend=first), 0.0)
    falls = np.stack([scipy.signal.lfilter([1 - keep], [1, -keep], fall) for keep in FALL_KEEP], axis=1)
    return np.concatenate([passed.reshape(a.size, -1), sided, falls], axis=1)


@dataclass(frozen=True)
class ModeTable:
    """One session, standardised: beta [W + T] with the window before it first, amplitude [T], `columns_of` it with the window's rows before
    it [W + T, COLUMNS], usable steps [T].
    """

    beta: Floats
    amplitude: Floats
    columns: Floats
    usable: NDArray[np.bool_]

    @classmethod
    def of(cls, session: SessionTrajectory, scale: Scale, otherwise: float | None) -> ModeTable:
        """Build the tables of a session after the dose before it, which is `otherwise` where no record says it; its first amplitude for
        None."""
        a, window, before = held_amplitude(session), session.lead_beta.size, lead_dose(session, otherwise)
        first = float(a[0]) if before is None else before
        columns = columns_of(np.concatenate([np.full(window, first), a]), first)
        return cls(scale.beta(session.padded_beta), a, columns, session.usable())


@dataclass(frozen=True)
class ModeDynamics:
    """A fitted model, or draws from its posterior; n sessions, D sets of coefficients.

    Attributes:
        phi: autoregression of eta on lags 1 ... W, [W]. gains: of the columns, [D, COLUMNS]. levels: mu + visit + session, [D, n].
        noise_weights: of the log of an innovation's scale on (1, a, predicted beta), [3].
        shares: lambda / (1 + lambda) of the visits' and the sessions' levels.
        before: dose before each session, [n]; NaN: its first amplitude.
    """

    phi: Floats
    gains: Floats
    levels: Floats
    noise_weights: Floats
    shares: dict[str, float]
    before: Floats

    def innovations(self, tables: Sequence[ModeTable]) -> list[Floats]:
        """Compute standardised innovations of the steps of each session, [D, T]; NaN where a step is not usable."""
        found = []
        for i, table in enumerate(tables):
            eta = table.beta - self.gains @ table.columns.T - self.levels[:, i : i + 1]
            found.append(innovations_of(eta, table.beta, table.amplitude, table.usable, self.phi, self.noise_weights))
        return found

    def usual_lead(self) -> Floats:
        """Compute standardised beta of each session, [n], where the window before it is not known."""
        doses = after_doses(np.ones(self.before.size), self.before)
        lasting = np.stack([columns_of(np.array([dose]), float(dose))[0] for dose in doses], axis=1)
        return np.asarray((self.levels + self.gains @ lasting).mean(0), dtype=np.float64)

    def response(self, first: Floats, steps: int) -> ModeResponse:
        """Begin the answer to amplitudes that come step by step, the first of them [P, D, n]."""
        return ModeResponse(self.gains, after_doses(first, self.before))


class ModeResponse:
    """The answer of beta to amplitudes [P, D, n] as they come, with gains [D, COLUMNS]."""

    def __init__(self, gains: Floats, first: Floats) -> None:
        self._gains, self._filters = gains, Filters(first)

    def lasting(self) -> Floats:
        """Answer [P, D, n] before the first amplitudes."""
        return np.einsum("kpdn,dk->pdn", self._filters.columns, self._gains)

    def step(self, a: Floats) -> Floats:
        """Answer [P, D, n] once the amplitudes a are in force."""
        return np.einsum("kpdn,dk->pdn", self._filters.step(a), self._gains)


@dataclass(frozen=True)
class FittedModes:
    """The posterior of a fit, and what draws from it need besides."""

    fit: MixedFit
    visit: Indices
    phi: Floats
    noise_weights: Floats
    before: Floats

    def drawn(self, draws: int, rng: np.random.Generator) -> ModeDynamics:
        """Draw the coefficients."""
        return self._of(self.fit.draws(draws, rng))

    @property
    def mean(self) -> ModeDynamics:
        """Model at its posterior mean (D = 1)."""
        return self._of(self.fit.coefficients[None])

    def _of(self, coefficients: Floats) -> ModeDynamics:
        gains, levels = _split(coefficients, self.visit)
        shares = {name: self.fit.share(name) for name in ("visit", "session")}
        return ModeDynamics(self.phi, gains, levels, self.noise_weights, shares, self.before)


def fit_modes(buffer: ReplayBuffer, tables: Sequence[ModeTable], otherwise: float | None) -> FittedModes:
    """Fit the posterior of the model; `otherwise` as the tables were made with.

    Raises:
        ValueError: fewer than two sessions with usable steps.
    """
    require_two_sessions("a model of beta's answer", sum(bool(t.usable.any()) for t in tables))
    window, visit = buffer.settings.window, visit_numbers(buffer)
    usable = [t.usable for t in tables]
    phi = np.zeros(window)
    for _ in range(TURNS):
        _, coefficients = MODE_MODEL.likeliest(mode_sums(tables, visit, phi))
        phi = autoregression(_residuals(tables, coefficients, visit), usable, window)
    fit = MODE_MODEL.fit(mode_sums(tables, visit, phi))
    betas, amplitudes = [t.beta for t in tables], [t.amplitude for t in tables]
    noise = log_noise_weights(_residuals(tables, fit.coefficients, visit), betas, amplitudes, usable, phi)
    return FittedModes(fit, visit, phi, noise, lead_doses(buffer.sessions, otherwise))


MODE_MODEL = MixedModel(
    1 + COLUMNS,
    {
        "fast": [1 + m * SHAPES for m in range(SLOW)],
        "slow": [1 + m * SHAPES for m in range(SLOW, len(TIMES))],
        "shape": [1 + m * SHAPES + k for m in range(len(TIMES)) for k in range(1, SHAPES)],
        "sided": range(1 + SHAPES * len(TIMES), 1 + COLUMNS - len(FALL_TIMES)),
        "falls": range(1 + COLUMNS - len(FALL_TIMES), 1 + COLUMNS),
    },
    {},
)
"""The mixed model of the columns (1, modes)."""


def mode_sums(tables: Sequence[ModeTable], visit: Indices, phi: Floats) -> SessionSums:
    """Collect the sums of every session for `MODE_MODEL`."""
    return level_sums([t.beta for t in tables], [t.columns for t in tables], [t.usable for t in tables], visit, phi)


def _split(coefficients: Floats, visit: Indices) -> tuple[Floats, Floats]:
    """Compute gains [D, COLUMNS] and levels [D, n] from coefficients [D, p]."""
    return split_coefficients(coefficients, visit, COLUMNS)


def _residuals(tables: Sequence[ModeTable], coefficients: Floats, visit: Indices) -> list[Floats]:
    gains, levels = _split(coefficients[None], visit)
    return [table.beta - table.columns @ gains[0] - levels[0, i] for i, table in enumerate(tables)]
