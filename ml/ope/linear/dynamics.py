"""A linear model of beta: the answer to the amplitude, levels of visits and sessions, and an autoregression around them.

    y_t = mu + visit + session + g(amplitudes up to t) . beta + eta_t,    eta_t = sum over l <= W of phi_l eta_{t-l} + e_t

y is standardised (log) beta. Regressing beta on its own past alone would take sessions of different level for a slow walk and forget what
the amplitude does. With levels as random effects, the answer to the amplitude is read off within sessions, where random amplitudes are an
experiment. Sessions of one visit that differ little add what they show between them. Estimated alternately: the mixed model on rows
filtered by phi (Cochrane and Orcutt 1949; generalised least squares), then phi on what it leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ml.ope.doses import DECAYS, after_doses, fresh_memory, held_amplitude, lead_dose, lead_doses, memories
from ml.ope.estimate import require_two_sessions
from ml.ope.scale import Scale
from ml.statistics.mixed import MixedModel
from ml.statistics.nested import SessionSums
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

TURNS = 3
LARGEST_ROOT = 0.98
"""No autoregression keeps a root of larger modulus: its memory would outlast 50 steps."""

DOSE_RATIO = 1e4
"""Prior variance of the fall of beta from no stimulation to cDBS, in innovation variances: next to flat."""

SATURATION = 0.3
NOISE_LIMIT = 3.0
ANSWERS = 7


def answers(a: Floats, memory: Floats) -> Floats:
    """Compute what beta answers to, [N, 7]: the dose (average over about 20 steps), three differences in timing from it, three curvatures.

    Args:
        a: amplitude, [N]. memory: memories of amplitudes with a in them, [N, 3]; `ml.ope.doses.DECAYS`.
    """
    return np.stack(_answers(a, memory.T), axis=1)


def _answers(a: Floats, memory: Floats) -> list[Floats]:
    """Compute `answers` one by one, of any shape [...], for memories [3, ...]."""
    fast, dose, slow = memory
    saturating = 4 * (dose / (dose + SATURATION) - dose / (1 + SATURATION))
    return [dose, a - dose, fast - dose, slow - dose, 4 * (dose**2 - dose), 4 * (a**2 - a), saturating]


def noise_features(a: Floats, predicted: Floats) -> Floats:
    """Compute regressors of the log scale of an innovation, [..., 3], for amplitudes and predicted beta of one shape."""
    return np.stack([np.ones_like(a), a, np.clip(predicted, -NOISE_LIMIT, NOISE_LIMIT)], axis=-1)


@dataclass(frozen=True)
class SessionTable:
    """One session, standardised: beta [W + T] with the window before it first, answers [W + T, 7], amplitude and usable steps [T]."""

    beta: Floats
    answers: Floats
    amplitude: Floats
    usable: NDArray[np.bool_]

    @classmethod
    def of(cls, session: SessionTrajectory, scale: Scale, otherwise: float | None = None) -> SessionTable:
        """Build the tables of a session after the dose before it, which is `otherwise` where no record says it
        (`ml.ope.doses.lead_dose`)."""
        a, before = held_amplitude(session), lead_dose(session, otherwise)
        own = answers(a, memories(a, before))
        first = a[:1] if before is None else np.array([before])
        lead = answers(first, fresh_memory(first))
        window = session.lead_beta.size
        return cls(scale.beta(session.padded_beta), np.concatenate([np.repeat(lead, window, axis=0), own]), a, session.usable())


@dataclass(frozen=True)
class Dynamics:
    """A fitted model; n sessions, D sets of coefficients.

    Attributes:
        phi: autoregression of eta on lags 1 ... W, [W].
        beta: answers to the amplitude, [D, 7]. levels: mu + visit + session, [D, n].
        noise_weights: of the log of an innovation's scale on (1, a, predicted beta), [3].
        shares: lambda / (1 + lambda) of the visits' and the sessions' levels; how far they exceed one step's noise.
        before: dose before each session, [n]; NaN: its first amplitude. log_evidence: of the fit, up to a constant of the rows.
        ratios: likeliest lambdas of the fit, by group.
    """

    phi: Floats
    beta: Floats
    levels: Floats
    noise_weights: Floats
    shares: dict[str, float]
    before: Floats
    log_evidence: float = 0.0
    ratios: Floats = field(default_factory=lambda: np.ones(4))

    def innovations(self, tables: Sequence[SessionTable]) -> list[Floats]:
        """Compute standardised innovations of the steps of each session, [D, T]; NaN where a step is not usable."""
        found = []
        for i, table in enumerate(tables):
            eta = table.beta - self.beta @ table.answers.T - self.levels[:, i : i + 1]
            found.append(innovations_of(eta, table.beta, table.amplitude, table.usable, self.phi, self.noise_weights))
        return found

    def response(self, first: Floats, steps: int) -> LinearResponse:
        """Begin the answer to amplitudes that come step by step, the first of them [P, D, n]."""
        return LinearResponse(self.beta, after_doses(first, self.before))

    def usual_lead(self) -> Floats:
        """Compute standardised beta of each session under the mean of the random amplitudes, [n]: where the window before it is not
        known."""
        return np.asarray(self.levels[0] + self.beta[0, 0] * 0.65, dtype=np.float64)


class LinearResponse:
    """The answer of beta to amplitudes [P, D, n] as they come after those `before` them, with coefficients [D, 7]."""

    def __init__(self, beta: Floats, before: Floats) -> None:
        self._gains = [gain[:, None] for gain in beta.T]
        self._memory = np.repeat(before[None], len(DECAYS), axis=0)

    def lasting(self) -> Floats:
        """Answer [P, D, n] before the first amplitudes."""
        return self._answer(self._memory[0])

    def step(self, a: Floats) -> Floats:
        """Answer [P, D, n] once the amplitudes a [P, D, n] are in force."""
        for memory, decay in zip(self._memory, DECAYS, strict=True):
            memory *= decay
            memory += (1 - decay) * a
        return self._answer(a)

    def _answer(self, a: Floats) -> Floats:
        total = np.zeros_like(a)
        for gain, values in zip(self._gains, _answers(a, self._memory), strict=True):
            total += gain * values
        return total


def fit_dynamics(
    buffer: ReplayBuffer, tables: Sequence[SessionTable], draws: int, seed: int, otherwise: float | None = None
) -> tuple[Dynamics, Dynamics]:
    """Fit the model: at its posterior mean (D = 1), and `draws` of its coefficients from their posterior (phi and noise as in the first).

    Args:
        otherwise: the dose before sessions of which no record says it, as the tables were made with.

    Raises:
        ValueError: fewer than two sessions with usable steps.
    """
    require_two_sessions("the linear model", sum(bool(t.usable.any()) for t in tables))
    window, visit = buffer.settings.window, visit_numbers(buffer)
    phi = np.zeros(window)
    for _ in range(TURNS):
        _, coefficients = LINEAR_MODEL.likeliest(linear_sums(tables, visit, phi))
        beta, levels = _split(coefficients[None], visit)
        phi = autoregression(_residuals(tables, beta[0], levels[0]), [t.usable for t in tables], window)
    fit = LINEAR_MODEL.fit(linear_sums(tables, visit, phi))
    beta, levels = _split(fit.coefficients[None], visit)
    shares = {name: fit.share(name) for name in ("visit", "session")}
    usable, amplitudes = [t.usable for t in tables], [t.amplitude for t in tables]
    noise = log_noise_weights(_residuals(tables, beta[0], levels[0]), [t.beta for t in tables], amplitudes, usable, phi)
    mean = Dynamics(phi, beta, levels, noise, shares, lead_doses(buffer.sessions, otherwise), fit.log_evidence, fit.likeliest)
    drawn = _split(fit.draws(draws, np.random.default_rng([seed, 0xD7A])), visit)
    return mean, replace(mean, beta=drawn[0], levels=drawn[1])


def innovations_of(eta: Floats, beta: Floats, amplitude: Floats, usable: NDArray[np.bool_], phi: Floats, noise_weights: Floats) -> Floats:
    """Compute standardised innovations [D, T] of one session from what levels and answers leave of it, eta [D, W + T]; NaN where not
    usable."""
    windows = np.lib.stride_tricks.sliding_window_view(eta, phi.size, axis=1)[:, :-1]
    innovation = eta[:, phi.size :] - windows @ phi[::-1]
    predicted = beta[phi.size :] - innovation
    scale = np.exp(noise_features(np.broadcast_to(amplitude, predicted.shape), predicted) @ noise_weights)
    return np.asarray(np.where(usable, innovation / scale, np.nan), dtype=np.float64)


def visit_numbers(buffer: ReplayBuffer) -> Indices:
    """Assign a number to each session's visit among those of the buffer, [n], from 0."""
    return np.unique([s.visit for s in buffer.sessions], return_inverse=True)[1].astype(np.int64)


def split_coefficients(coefficients: Floats, visit: Indices, width: int) -> tuple[Floats, Floats]:
    """Split answers [D, width] and levels [D, n] from coefficients [D, p] of columns (1, answers), visits and sessions."""
    visits, sessions = coefficients[:, 1 + width : -visit.size], coefficients[:, -visit.size :]
    return coefficients[:, 1 : 1 + width], coefficients[:, :1] + visits[:, visit] + sessions


def largest_root(phi: Floats) -> float:
    """Compute the largest modulus of a root of the autoregression; 0 where there is none."""
    roots = np.roots(np.concatenate([[1.0], -phi]))
    return float(np.abs(roots).max()) if roots.size else 0.0


def level_sums(
    betas: Sequence[Floats], answers: Sequence[Floats], usable: Sequence[NDArray[np.bool_]], visit: Indices, phi: Floats
) -> SessionSums:
    """Collect sums over the usable rows of every session, filtered by phi: beta [W + T] on (1, answers [W + T, k])."""
    rest, joint = 1 - float(phi.sum()), []
    for beta, answer, steps in zip(betas, answers, usable, strict=True):
        rows = filtered(np.concatenate([answer, beta[:, None]], axis=1), phi)[steps]
        rows = np.concatenate([np.full((len(rows), 1), rest), rows], axis=1)
        joint.append(rows.T @ rows)
    return SessionSums(np.stack(joint), np.array([int(steps.sum()) for steps in usable]), visit)


LINEAR_MODEL = MixedModel(1 + ANSWERS, {"timing": (2, 3, 4), "shape": (5, 6, 7)}, {1: DOSE_RATIO})
"""The mixed model of (1, answers)."""


def linear_sums(tables: Sequence[SessionTable], visit: Indices, phi: Floats) -> SessionSums:
    """Collect the sums of every session for `LINEAR_MODEL`."""
    return level_sums([t.beta for t in tables], [t.answers for t in tables], [t.usable for t in tables], visit, phi)


def _split(coefficients: Floats, visit: Indices) -> tuple[Floats, Floats]:
    """Compute answers [D, 7] and levels [D, n] from coefficients [D, p]."""
    return split_coefficients(coefficients, visit, ANSWERS)


def filtered(values: Floats, phi: Floats) -> Floats:
    """Compute v_t - sum over l of phi_l v_{t-l}, [T, k], from values [W + T, k]; NaN where one of them is."""
    windows = np.lib.stride_tricks.sliding_window_view(values, phi.size, axis=0)[:-1]
    return np.asarray(values[phi.size :] - windows @ phi[::-1], dtype=np.float64)


def autoregression(residuals: Sequence[Floats], usable: Sequence[NDArray[np.bool_]], window: int) -> Floats:
    """Fit phi [W] by least squares on what levels and answers leave of each session, [W + T], its roots kept inside `LARGEST_ROOT`."""
    gram, moment = 1.0 * np.eye(window), np.zeros(window)
    for eta, steps in zip(residuals, usable, strict=True):
        x = np.lib.stride_tricks.sliding_window_view(eta, window)[:-1][steps]
        gram, moment = gram + x.T @ x, moment + x.T @ eta[window:][steps]
    phi = np.asarray(np.linalg.solve(gram, moment)[::-1], dtype=np.float64)
    root = largest_root(phi)
    kappa = min(1.0, LARGEST_ROOT / root) if root > 0 else 1.0
    return np.asarray(phi * kappa ** np.arange(1, window + 1), dtype=np.float64)


def log_noise_weights(
    residuals: Sequence[Floats], betas: Sequence[Floats], amplitudes: Sequence[Floats], usable: Sequence[NDArray[np.bool_]], phi: Floats
) -> Floats:
    """Fit the weights of the log scale of innovations, [3], from what levels and answers leave of each session, [W + T]."""
    designs, logs = [], []
    for eta, beta, amplitude, steps in zip(residuals, betas, amplitudes, usable, strict=True):
        innovation = filtered(eta[:, None], phi)[steps, 0]
        designs.append(noise_features(amplitude[steps], beta[phi.size :][steps] - innovation))
        logs.append(np.log(np.maximum(np.abs(innovation), 1e-6)))
    design, target = np.concatenate(designs), np.concatenate(logs)
    return np.asarray(np.linalg.solve(design.T @ design + np.diag([1e-6, 10.0, 10.0]), design.T @ target), dtype=np.float64)


def _residuals(tables: Sequence[SessionTable], beta: Floats, levels: Floats) -> list[Floats]:
    return [table.beta - table.answers @ beta - levels[i] for i, table in enumerate(tables)]
