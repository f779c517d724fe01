"""Random sessions of a visit, and those near a stated amplitude: laid out, bounded in mA and signed with the plan."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from app.platform.errors import Invalid
from app.platform.numbers import ma
from app.study.cdbs_amplitude import held_settings, lacking, plausible
from app.tables.participants import SettingsVersion
from app.tables.plans import PlanItem
from app.tables.visits import Visit
from ml.designs import LOW_AMPLITUDE, Bound, Decision, DesignedSession, DesignSettings, amplitudes, lay_out, near_session

RESOLUTION_MA: Final = 0.1
"""What a stimulator rounds amplitudes to."""
MAX_SEED: Final = 2**31 - 1
NEAR: Final = "near"
"""The design of a session that stays near a stated amplitude."""


def is_held(item: PlanItem) -> bool:
    """Return True for a session that stays near a stated amplitude."""
    return item.design is not None and item.design["design"] == NEAR


@dataclass(frozen=True)
class SideBound:
    """Milliamperes of one side.

    Attributes:
        side: hemisphere; None where the cDBS amplitude is stated without one. cdbs_ma: its cDBS amplitude.
        lowest_ma: no step is below it: B of cDBS, rounded up to what a stimulator gives.
        low_ma: below this the session stays for `LOW_SECONDS` at most, and only at its end.
    """

    side: str | None
    cdbs_ma: float
    lowest_ma: float
    low_ma: float


@dataclass(frozen=True)
class Planned:
    """Design of one random session.

    Attributes:
        design: `paper`, where the device draws again at every step, `stratified`, `ladder` or `near`. level: of the session; None where it
            has none.
        seed: of the draws; None in the paper's design. lower_bound: B. period_s: of a step. holds: empty in the paper's design.
        bounds: in milliamperes, at the plan's approval; empty before.
    """

    design: str
    level: float | None
    seed: int | None
    lower_bound: float
    period_s: float
    holds: tuple[Decision, ...]
    bounds: tuple[SideBound, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Convert for storage."""
        return asdict(self) | {"holds": [asdict(h) for h in self.holds], "bounds": [asdict(b) for b in self.bounds]}

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> Planned:
        """Read what `as_json` stored."""
        nested = {"holds": tuple(Decision(**h) for h in stored["holds"]), "bounds": tuple(SideBound(**b) for b in stored["bounds"])}
        return cls(**stored | nested)

    def first_steps(self, steps: int) -> NDArray[np.float64]:
        """Return the amplitude fraction of so many steps, [steps]: cDBS after the last hold."""
        return amplitudes(self.holds, steps)

    @property
    def bound(self) -> Bound:
        """Lower bound B in force."""
        return Bound(self.lower_bound)

    @property
    def low_seconds(self) -> float:
        """Time that the session is below `LOW_AMPLITUDE`, s."""
        return sum(h.steps for h in self.holds if h.amplitude < LOW_AMPLITUDE) * self.period_s


def planned_sessions(settings: SettingsVersion, code: str, earlier_visits: int, count: int, minutes: float, bound: float) -> list[Planned]:
    """Design the random sessions of one visit, by the participant's settings.

    Levels are spread over `early_visits` visits; after these a new round of strata begins. The draws depend on the participant's code and
    the round alone, so that drafting a plan again gives the same ones.

    Args:
        settings: design, ladder and period. code: the participant's. earlier_visits: with a plan of this design.
        count: random sessions of the visit. minutes: of each. bound: below which nothing is drawn, fraction of cDBS.

    Raises:
        Invalid: no amplitude is between the bound and cDBS.
    """
    if count == 0:
        return []
    if bound >= 1:
        raise Invalid(
            "Random sessions have nothing to draw: the lowest amplitude of the plan is that of cDBS.",
            "Lower the limit, or plan the visit without random sessions.",
        )
    if settings.design == "paper":
        return [Planned("paper", None, None, bound, settings.period_s, ())] * count
    number, place = divmod(earlier_visits, settings.early_visits)
    wanted = DesignSettings(
        name="stratified",
        visits=settings.early_visits,
        sessions=count,
        steps=max(1, round(60 * minutes / settings.period_s)),
        period_s=settings.period_s,
        bound=Bound(bound),
        ladder=settings.design_ladder,
        seed=seed_of(code, number),
    )
    return [_planned(session, wanted) for session in lay_out(wanted) if session.visit == place + 1]


def near_sessions(
    levels: Sequence[float],
    settings: SettingsVersion,
    code: str,
    visit_number: int,
    minutes: float,
    bound: float,
    cdbs_ma: float | None = None,
) -> list[Planned]:
    """Design sessions near stated amplitudes. Drafting the visit again gives the same draws.

    Args:
        levels: fraction of cDBS of each session. settings: B and period. code: the participant's. visit_number, minutes: of the visit, and
            of each session.
        bound: below which nothing is drawn, fraction of cDBS. cdbs_ma: the cDBS amplitude, for words; None where it is not known.

    Raises:
        Invalid: a level below B or the bound, or cDBS itself.
    """
    seed = seed_of(f"{code}/{NEAR}", visit_number)
    steps = max(1, round(60 * minutes / settings.period_s))
    found = []
    for number, level in enumerate(levels):
        if not settings.bound.allows(level):
            wanted, lowest, highest = (_amplitude(share, cdbs_ma) for share in (level, settings.bound, 1.0))
            raise Invalid(
                f"A session held near {wanted} cannot be planned: the participant's lower bound is {lowest}, and cDBS {highest}.",
                "Name an amplitude from the lower bound to below that of cDBS.",
            )
        if level < bound:
            raise Invalid(
                f"A session is to be held near {_amplitude(level, cdbs_ma)}, and the lowest amplitude of the plan is "
                f"{_amplitude(bound, cdbs_ma)}.",
                "Lower the limit, or hold the session at or above it.",
            )
        session = near_session(level, steps, settings.period_s, Bound(bound), seed, number)
        found.append(Planned(NEAR, level, seed, bound, settings.period_s, session.decisions))
    return found


def _amplitude(fraction: float, cdbs_ma: float | None) -> str:
    return f"{fraction:.2f} of the cDBS amplitude" if cdbs_ma is None else f"{ma(fraction * cdbs_ma)} mA"


def seed_of(code: str, number: int) -> int:
    """Return the seed of a participant's designs in one round of early visits."""
    digest = hashlib.sha256(f"{code.upper()}/{number}".encode()).digest()
    return int.from_bytes(digest[:8], "big") % MAX_SEED


def bounds_of(visit: Visit, settings: SettingsVersion, bound: Bound) -> tuple[SideBound, ...]:
    """Return the bounds of a visit's random sessions in milliamperes, by side.

    Raises:
        Invalid: the cDBS amplitude is not stated, so that no bound in milliamperes can be signed; an amplitude that no device gives.
    """
    stated = [
        (str(a.hemisphere), plausible(a.amplitude_ma, f"Visit {visit.number} states")) for a in visit.cdbs_amplitudes if a.program == 0
    ]
    usual = plausible(held_settings(visit, settings).cdbs_amplitude_ma, "The participant's settings state")
    sides: list[tuple[str | None, float]] = list(stated) or ([(None, usual)] if usual is not None else [])
    if not sides:
        raise Invalid(
            f"The plan has random sessions with a lower bound, a fraction of cDBS, but {lacking(visit, None, settings)}.",
            "State the cDBS amplitude at the visit or in the participant's settings; then approve the plan.",
        )
    return tuple(SideBound(side, ma, rounded_up(bound * ma), rounded_up(LOW_AMPLITUDE * ma)) for side, ma in sides)


def rounded_up(milliamperes: float) -> float:
    """Return the least amplitude that a stimulator gives and that is not below this one, mA."""
    return round(math.ceil(milliamperes / RESOLUTION_MA - 1e-6) * RESOLUTION_MA, 6)


def offered(fraction: float, bound: Bound, cdbs_ma: float | None) -> str:
    """Write an amplitude as the plan's form proposes it: in steps of 0.1 mA, or 0.01 of cDBS, and one that the plan takes.

    Args:
        fraction: of cDBS, that is to be kept. bound: B. cdbs_ma: None where it is not known.
    """
    scale, step, digits = (1.0, 0.01, 2) if cdbs_ma is None else (cdbs_ma, RESOLUTION_MA, 1)
    least, below_cdbs = bound.steps(step / scale), math.ceil(scale / step - 1e-6) - 1
    return f"{max(least, min(below_cdbs, round(fraction * scale / step))) * step:.{digits}f}"


def delivered_ma(fraction: float, bound: SideBound) -> float:
    """Return what a stimulator gives for a fraction of cDBS: rounded to its resolution, within the bound and cDBS, mA.

    Rounding makes no amplitude one of those at which a session stays for `LOW_SECONDS` at most.
    """
    nearest = round(round(fraction * bound.cdbs_ma / RESOLUTION_MA) * RESOLUTION_MA, 6)
    least = bound.lowest_ma if fraction < LOW_AMPLITUDE else max(bound.lowest_ma, bound.low_ma)
    return min(max(nearest, least), bound.cdbs_ma)


def _planned(session: DesignedSession, wanted: DesignSettings) -> Planned:
    return Planned(session.design, session.level, session.seed, wanted.bound, wanted.period_s, session.decisions)
