"""Exploration designs: which amplitudes the random sessions of early visits try, laid out before the visit.

Designs, by their names:

* `paper`: a new uniform draw on [B, 1] every step (Gao et al. 2023, section 6.1). The mean over a minute hardly ever leaves the middle.
* `stratified`: each random session has a level of its own, stratified over [B, 1] across sessions and visits. Draws around it stay constant
  for 10 to 60 s (log-uniform). A titration ladder (1, 0.8, 0.6, ..., two minutes each) may come once in each visit.
* `near`: a session near one stated amplitude, as a verdict asks for: draws within `NEAR_SPREAD` of it.

Safety comes before information. Nothing is below B. Anything below `LOW_AMPLITUDE` comes in the last `LOW_SECONDS` of a session, so it
lasts no longer and ends with the session. One hold is one decision. Its density is conditional on the level and on which bound is in force;
`Decision.log_density` gives it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
DesignName = Literal["paper", "stratified"]
SessionDesign = Literal["paper", "stratified", "ladder", "near"]

LOW_AMPLITUDE: Final = 0.6
"""Fraction of the cDBS amplitude below which a session may stay for `LOW_SECONDS` at most."""
LOW_SECONDS: Final = 300.0
HOLD_SECONDS: Final = (10.0, 60.0)
SPREAD: Final = 0.12
"""Draws around a level reach this far, as a fraction of the cDBS amplitude."""
NEAR_SPREAD: Final = 0.05
"""Draws of a session near an amplitude reach this far from it, as a fraction of the cDBS amplitude."""
EVERYWHERE: Final = 0.2
"""Share of draws that come from all of [B, 1], so that every amplitude has a density in every session."""
EARLY_RANDOM_SESSIONS: Final = 3
"""Random sessions that a visit is offered while there is no policy to test: with a cDBS session first, an hour."""
LADDER_STEP: Final = 0.2
LADDER_SECONDS: Final = 120.0


class Bound(float):
    """Lower bound B of random sessions: the lowest amplitude that they try, as a fraction of the cDBS amplitude. It never bounds a policy.

    It is a number, so that records store it as one.

    Raises:
        ValueError: a number outside [0, 1).
    """

    def __new__(cls, fraction: float) -> Bound:
        """Check the range."""
        if not 0 <= fraction < 1:
            raise ValueError(f"the lower bound must be in [0, 1), not {fraction}")
        return super().__new__(cls, fraction)

    def allows(self, level: float) -> bool:
        """Decide whether a session may stay near a level: from B to below cDBS."""
        return self <= level < 1

    def amplitudes(self, shares: Floats) -> Floats:
        """Place shares of the range, any shape from 0 to 1, on [B, 1]."""
        return np.asarray(self + (1 - self) * shares, dtype=np.float64)

    @property
    def early_lowest(self) -> float:
        """Lowest amplitude of a session before its last `LOW_SECONDS`."""
        return max(self, LOW_AMPLITUDE)

    def steps(self, step: float) -> int:
        """Count the steps of a device from 0 to the least of its amplitudes that is not below B; `step` is a fraction of cDBS."""
        return math.ceil(self / step - 1e-6)


DEFAULT_BOUND: Final = Bound(0.3)


@dataclass(frozen=True)
class Hold:
    """One decision of an exploration design: an amplitude that is drawn once and then stays constant.

    Attributes:
        start, steps: first step and length. log_density: of the amplitude given the session's level and the bound in force. None where it
            is unknown (sustained draws of no stated design) or where nothing was drawn (a titration ladder).
    """

    start: int
    steps: int
    log_density: float | None


@dataclass(frozen=True, kw_only=True)
class DesignSettings:
    """Settings of a design.

    Attributes:
        name: `stratified` (the default) or `paper`. visits, sessions: early visits, and random sessions in each.
        steps: T of a session. period_s: seconds per step. bound: B.
        ladder: a titration ladder takes the place of the first random session of each visit (`stratified` alone).
        seed: the same one gives the same design.

    Raises:
        ValueError: a value outside its range, or a ladder in the paper's design; the message names it.
    """

    visits: int
    sessions: int
    steps: int
    name: DesignName = "stratified"
    period_s: float = 2.0
    bound: Bound = DEFAULT_BOUND
    ladder: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for what in ("visits", "sessions", "steps"):
            if getattr(self, what) < 1:
                raise ValueError(f"a design needs at least one of its {what}, not {getattr(self, what)}")
        if not (math.isfinite(self.period_s) and self.period_s > 0):
            raise ValueError(f"period_s must be above 0 s, not {self.period_s}")
        if self.name not in ("paper", "stratified"):
            raise ValueError(f"there is no design {self.name!r}; use 'stratified' or 'paper'")
        if self.ladder and self.name == "paper":
            raise ValueError("the paper's design has no titration ladder: choose the stratified design, or leave the ladder out")


@dataclass(frozen=True)
class Decision:
    """One amplitude that stays constant.

    Attributes:
        start, steps: first step and length. amplitude: fraction of cDBS.
        log_density: of the amplitude given the session's level and the bound in force; None where nothing was drawn (ladder).
    """

    start: int
    steps: int
    amplitude: float
    log_density: float | None


def amplitudes(decisions: Sequence[Decision], steps: int) -> Floats:
    """List the amplitude fraction of the first steps of decisions in order, [steps]: cDBS after the last one."""
    held = np.repeat([d.amplitude for d in decisions], [d.steps for d in decisions])
    return np.concatenate([held, np.ones(max(0, steps - held.size))])[:steps]


@dataclass(frozen=True)
class DesignedSession:
    """One session of a design.

    Attributes:
        design: `paper`, `stratified`, `ladder` or `near`. visit: 1, 2, ... number: within the visit, 0, 1, ...
        level: of the session; None where it has none. seed: of the design. decisions: in order, without gaps.
    """

    design: SessionDesign
    visit: int
    number: int
    level: float | None
    seed: int
    decisions: tuple[Decision, ...]

    @property
    def amplitudes(self) -> Floats:
        """Amplitude fraction of every step, [T]."""
        return np.repeat([d.amplitude for d in self.decisions], [d.steps for d in self.decisions])

    def first_steps(self, steps: int) -> Floats:
        """List the amplitude fraction of so many steps, [steps]: cDBS after the last decision."""
        return amplitudes(self.decisions, steps)

    @property
    def holds(self) -> tuple[Hold, ...]:
        """Decisions as a `SessionTrajectory` keeps them: none in the paper's design, where every step is one."""
        return () if self.design == "paper" else tuple(Hold(d.start, d.steps, d.log_density) for d in self.decisions)


def lay_out(settings: DesignSettings) -> tuple[DesignedSession, ...]:
    """Design every random session of the early visits, by visit and number."""
    levels = stratified_levels(settings) if settings.name == "stratified" else None
    result = []
    for visit in range(1, settings.visits + 1):
        for number in range(settings.sessions):
            rng = np.random.default_rng([settings.seed, 0x6C6576, visit, number])
            if levels is None:
                result.append(_paper_session(settings, visit, number, rng))
            elif settings.ladder and number == 0:
                result.append(ladder_session(settings, visit, number))
            else:
                result.append(_held_session(settings, visit, number, float(levels[visit - 1, number - settings.ladder]), rng))
    return tuple(result)


def stratified_levels(settings: DesignSettings) -> Floats:
    """Draw the levels of the sessions, [visits, sessions without the ladder], one in each of as many equal strata of [B, 1] as there are
    sessions.

    Each visit has one level in each coarse stratum (as many as it has sessions), in random order. Over the visits each fine stratum is used
    once. Within its stratum a level is uniform, so that every level alone is uniform on [B, 1].
    """
    visits, sessions = settings.visits, settings.sessions - settings.ladder
    if sessions == 0:
        return np.empty((visits, 0))
    rng = np.random.default_rng([settings.seed, 0x737472])
    fine = np.stack([rng.permutation(visits) for _ in range(sessions)], axis=1)
    place = np.arange(sessions) * visits + fine
    levels = (place + rng.random(place.shape)) / (visits * sessions)
    ordered = np.stack([row[rng.permutation(sessions)] for row in levels])
    return settings.bound.amplitudes(ordered)


@dataclass(frozen=True)
class DrawDensity:
    """Density of sustained amplitudes around a level: uniform within a distance of it, mixed with a share of uniform on all of [low, 1].

    Attributes:
        level: of the session. low: the bound in force: B, or at least `LOW_AMPLITUDE` outside the last minutes of a session.
        spread: the distance. everywhere: the share.

    Raises:
        ValueError: a bound or a level outside [0, 1].
    """

    level: float
    low: float
    spread: float = SPREAD
    everywhere: float = EVERYWHERE

    def __post_init__(self) -> None:
        if not (0 <= self.low < 1 and 0 <= self.level <= 1):
            raise ValueError(f"a level must be in [0, 1] and a bound in [0, 1), not {self.level} and {self.low}")

    @property
    def near(self) -> tuple[float, float]:
        """Range of the draws around the level; a level below the bound is lifted to it."""
        level = max(self.level, self.low)
        return max(self.low, level - self.spread), min(1.0, level + self.spread)

    def draw(self, rng: np.random.Generator) -> float:
        """Draw an amplitude."""
        low, high = (self.low, 1.0) if rng.random() < self.everywhere else self.near
        return float(rng.uniform(low, high))

    def density(self, amplitude: NDArray[np.float64] | float) -> Floats:
        """Compute the density at amplitudes, any shape; integrates to 1 over [low, 1]."""
        a = np.asarray(amplitude, dtype=np.float64)
        low, high = self.near
        everywhere = self.everywhere * ((a >= self.low) & (a <= 1)) / (1 - self.low)
        return np.asarray(everywhere + (1 - self.everywhere) * ((a >= low) & (a <= high)) / (high - low))


def near_density(level: float, low: float) -> DrawDensity:
    """Build the density of sustained amplitudes near one: uniform within `NEAR_SPREAD` of it, above the bound in force."""
    return DrawDensity(level, low, NEAR_SPREAD, everywhere=0.0)


def near_session(level: float, steps: int, period_s: float, bound: Bound, seed: int, number: int) -> DesignedSession:
    """Design a session near an amplitude; below `LOW_AMPLITUDE` in its last `LOW_SECONDS` alone, and as low as that allows before.

    Args:
        level: fraction of cDBS. steps: T. period_s: of a step. bound: B. seed, number: the same ones give the same draws.

    Raises:
        ValueError: a level below B, or of cDBS itself.
    """
    if not bound.allows(level):
        raise ValueError(f"a session is held near an amplitude from B, {bound:g}, to below 1, not near {level:g}")
    rng = np.random.default_rng([seed, 0x6E6561, number])
    decisions = _sustained_draws(steps, period_s, bound, rng, lambda low: near_density(level, low))
    return DesignedSession("near", 1, number, level, seed, decisions)


def near_doses(level: float, steps: int, period_s: float, bound: Bound) -> tuple[float, float]:
    """Compute the expected mean amplitude of a session near a level, over the session and over its last `LOW_SECONDS`."""
    late = min(steps, int(LOW_SECONDS / period_s))
    before, after = (float(np.mean(near_density(level, low).near)) for low in (bound.early_lowest, bound))
    return (before * (steps - late) + after * late) / steps, after


def hold_steps(rng: np.random.Generator, period_s: float) -> int:
    """Draw the length of one hold in steps, log-uniform between `HOLD_SECONDS`, at least one step."""
    low, high = HOLD_SECONDS
    seconds = low * (high / low) ** rng.random()
    return max(1, round(seconds / period_s))


def ladder_session(settings: DesignSettings, visit: int, number: int) -> DesignedSession:
    """Design the titration ladder: 1, 0.8, 0.6, ... for two minutes each, down to B at the lowest and within the safety limit.

    It ends with the session: outcomes are measured at the lowest rung, and low amplitudes come in the last minutes. Before it is cDBS. A
    session too short for all rungs has the first ones.
    """
    length = max(1, int(LADDER_SECONDS / settings.period_s))
    rungs: list[float] = []
    low_s = 0.0
    for rung in range(min(round(1 / LADDER_STEP) + 1, max(1, settings.steps // length))):
        amplitude = round(1.0 - LADDER_STEP * rung, 6)
        low_s += length * settings.period_s * (amplitude < LOW_AMPLITUDE)
        if amplitude < settings.bound or low_s > LOW_SECONDS:
            break
        rungs.append(amplitude)
    first = settings.steps - (len(rungs) - 1) * length
    decisions = [Decision(0, first, rungs[0], None)]
    decisions += [Decision(first + k * length, length, amplitude, None) for k, amplitude in enumerate(rungs[1:])]
    return DesignedSession("ladder", visit, number, None, settings.seed, tuple(decisions))


def _paper_session(settings: DesignSettings, visit: int, number: int, rng: np.random.Generator) -> DesignedSession:
    low = settings.bound
    drawn = rng.uniform(low, 1.0, settings.steps)
    decisions = tuple(Decision(k, 1, float(a), -math.log(1 - low)) for k, a in enumerate(drawn))
    return DesignedSession("paper", visit, number, None, settings.seed, decisions)


def _held_session(settings: DesignSettings, visit: int, number: int, level: float, rng: np.random.Generator) -> DesignedSession:
    decisions = _sustained_draws(settings.steps, settings.period_s, settings.bound, rng, lambda low: DrawDensity(level, low))
    return DesignedSession("stratified", visit, number, level, settings.seed, decisions)


def _sustained_draws(
    steps: int, period_s: float, bound: Bound, rng: np.random.Generator, law: Callable[[float], DrawDensity]
) -> tuple[Decision, ...]:
    """Draw sustained amplitudes by a density that depends on the bound in force."""
    # Low amplitudes come last: outcomes are measured there, and a session that is broken off has not been low without need.
    low_begins = max(0, steps - int(LOW_SECONDS / period_s))
    decisions: list[Decision] = []
    k = 0
    while k < steps:
        guarded = k < low_begins
        density = law(bound.early_lowest if guarded else bound)
        amplitude = density.draw(rng)
        length = min(hold_steps(rng, period_s), (low_begins if guarded else steps) - k)
        decisions.append(Decision(k, length, amplitude, float(np.log(density.density(amplitude)))))
        k += length
    return tuple(decisions)


@dataclass(frozen=True)
class Recognised:
    """Way in which logged amplitudes were drawn, as far as they show it.

    Attributes:
        kind: `every_step` (a new draw every step, as in the paper's design), `held` (draws that last), `constant`, or `unknown` with too
            few known steps.
        holds: (start, steps, amplitude) of every stretch of one amplitude; a gap of unknown amplitude ends a stretch.
        repeats: share of known steps whose amplitude is that of the known step just before; None where no step follows a known one.
    """

    kind: Literal["every_step", "held", "constant", "unknown"]
    holds: tuple[tuple[int, int, float], ...]
    repeats: float | None


def unstated_holds(recognised: Recognised, steps: int) -> tuple[Hold, ...]:
    """Convert stretches of sustained draws to decisions of unknown density that cover all `steps`; unknown steps extend the hold before
    them.

    A single amplitude throughout is one hold. Empty where the draws change every step.
    """
    if recognised.kind not in ("held", "constant"):
        return ()
    starts = [0, *(start for start, _, _ in recognised.holds[1:]), steps]
    return tuple(Hold(start, stop - start, None) for start, stop in pairwise(starts))


HELD_SHARE: Final = 0.5
"""Share of repeated amplitudes from which draws count as sustained: rounding a new draw to a device's 0.1 mA repeats far fewer."""
FEWEST_STEPS: Final = 10


def recognise(amplitude: Sequence[float] | Floats, tolerance: float = 1e-6) -> Recognised:
    """Recognise whether the random amplitudes of a session without a stated design were drawn every step or sustained.

    Args:
        amplitude: fraction of cDBS per step, [T]; NaN where unknown.
        tolerance: amplitudes closer than this are the same one; half the device's resolution where its log is rounded.
    """
    a = np.asarray(amplitude, dtype=np.float64)
    known = np.isfinite(a)
    follows = known[1:] & known[:-1]
    same = follows & (np.abs(np.diff(np.where(known, a, 0.0))) <= tolerance)
    starts = np.flatnonzero(known & np.concatenate([[True], ~same])) if a.size else np.empty(0, dtype=np.int64)
    holds = []
    for start in starts:
        stop = int(start) + 1
        while stop < a.size and same[stop - 1]:
            stop += 1
        holds.append((int(start), stop - int(start), float(a[start])))
    repeats = float(same.sum() / follows.sum()) if follows.any() else None
    if repeats is None or known.sum() < FEWEST_STEPS:
        return Recognised("unknown", tuple(holds), repeats)
    if np.ptp(a[known]) <= tolerance:
        return Recognised("constant", tuple(holds), repeats)
    return Recognised("held" if repeats >= HELD_SHARE else "every_step", tuple(holds), repeats)
