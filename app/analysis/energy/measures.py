"""Measures of the stimulation of a session, over all its sides and programs where their pulses are logged. No database.

With current I (A), pulse width w (s), rate f (Hz) and impedance R (ohm): charge per second I w f, and total electrical energy delivered per
second I^2 R w f (Koss et al. 2005, for currents), each summed over sides and programs. Relative to cDBS both are shares of what the cDBS
amplitude would have taken with the same pulses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from app.analysis.evidence.facts import Facts, Side


class Measure(StrEnum):
    """A measure of stimulation; all but the last two are relative to cDBS = 1."""

    AMPLITUDE = "mean_a"
    SQUARE = "mean_a2"
    ALL_SIDES = "all_sides_a2"
    CHARGE = "charge_uc_per_s"
    TEED = "teed_uw"


@dataclass(frozen=True)
class Pulses:
    """Width and rate of one side's program during a session; None where not logged, or changed within the session."""

    width_us: float | None
    rate_hz: float | None


@dataclass(frozen=True)
class Taken:
    """What one session took, by measure, absent where not known; `unknown_sides` have no logged width or rate or amplitude in mA."""

    session: Facts
    values: Mapping[Measure, float]
    unknown_sides: int


def pulses_of(events: Sequence[Mapping[str, object]], program: int, start_s: float, stop_s: float) -> Pulses:
    """Pulses of a program over a stretch of a recording, from its logged states of stimulation in time order.

    The state in force at the start counts; where a later state within the stretch has another width or rate, neither is known.
    """
    before = [e for e in events if _t(e) <= start_s + 1e-6]
    inside = [e for e in events if start_s + 1e-6 < _t(e) < stop_s]
    states = [_state(e, program) for e in ([before[-1]] if before else []) + inside]
    found = [s for s in states if s is not None]
    if not found:
        return Pulses(None, None)
    widths, rates = {w for w, _ in found if w is not None}, {r for _, r in found if r is not None}
    return Pulses(widths.pop() if len(widths) == 1 else None, rates.pop() if len(rates) == 1 else None)


def taken(session: Facts, pulses: Mapping[tuple[int, int], Pulses], impedance_ohm: float | None) -> Taken:
    """The measures of one session.

    Args:
        pulses: by recording and program. impedance_ohm: of the therapy contacts, where somebody states it.
    """
    values: dict[Measure, float] = {}
    if session.mean_fraction is not None:
        values[Measure.AMPLITUDE] = session.mean_fraction
    if "energy" in session.values:
        values[Measure.SQUARE] = session.values["energy"]
    known = [(s, p) for s in session.sides if (p := _complete(s, pulses)) is not None]
    if session.sides and len(known) == len(session.sides):
        values[Measure.CHARGE] = sum((s.milliamperes or 0.0) * 1e-3 * w * r for s, (w, r) in known)
        if impedance_ohm is not None:
            values[Measure.TEED] = sum((s.square_ma2 or 0.0) * 1e-6 * impedance_ohm * w * r for s, (w, r) in known)
    relative = _all_sides(session.sides, pulses)
    if relative is not None:
        values[Measure.ALL_SIDES] = relative
    return Taken(session, values, len(session.sides) - len(known))


def _all_sides(sides: Sequence[Side], pulses: Mapping[tuple[int, int], Pulses]) -> float | None:
    """Energy of all sides and programs relative to their cDBS amplitudes; with one side its mean a^2, whatever its pulses.

    A silent side took nothing and would have taken its share under cDBS, for which its pulses must be known; 0 where all were silent.
    """
    if len(sides) == 1:
        return sides[0].square
    if sides and all(side.milliamperes == 0 for side in sides):
        return 0.0
    spent = reference = 0.0
    for side in sides:
        width, rate = _pulses(side, pulses)
        if width is None or rate is None or side.square_ma2 is None or side.cdbs_ma is None:
            return None
        spent += width * rate * side.square_ma2
        reference += width * rate * side.cdbs_ma**2
    return spent / reference if reference > 0 else None


def _complete(side: Side, pulses: Mapping[tuple[int, int], Pulses]) -> tuple[float, float] | None:
    """Width and rate of a side whose amplitude in mA is known too; without any current they do not matter."""
    if side.milliamperes == 0:
        return 0.0, 0.0
    width, rate = _pulses(side, pulses)
    return None if width is None or rate is None or side.milliamperes is None else (width, rate)


def _pulses(side: Side, pulses: Mapping[tuple[int, int], Pulses]) -> tuple[float | None, float | None]:
    """Width (us) and rate (Hz) of a side's program, None where not known."""
    found = pulses.get((side.recording_id or 0, side.program), Pulses(None, None))
    return found.width_us, found.rate_hz


def mean(values: Sequence[float]) -> float | None:
    """Mean over sessions; None without any."""
    return float(np.mean(values)) if values else None


def _t(event: Mapping[str, object]) -> float:
    value = event.get("t_s")
    return float(value) if isinstance(value, int | float) else 0.0


def _state(event: Mapping[str, object], program: int) -> tuple[float | None, float | None] | None:
    """Width and rate of a program in one state; None where it does not stimulate there."""
    data = event.get("data")
    if not isinstance(data, Mapping):
        return None
    programs = data.get("programs")
    rate = data.get("rate_hz")
    for p in programs if isinstance(programs, list) else []:
        if isinstance(p, Mapping) and p.get("program") == program:
            width = p.get("pulse_width_us")
            return (float(width) if isinstance(width, int | float) else None, float(rate) if isinstance(rate, int | float) else None)
    return None
