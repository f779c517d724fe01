"""Dose that a stimulator delivers under its settings: the amplitude of each program, or unknown, and why. One function for all devices."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

UPPER_PLAUSIBLE_MA = 25.5
"""One byte of 0.1 mA; 25.5 means hold in RC+S, and nothing above can be set."""

LIMIT_TOLERANCE_MA = 0.05
UNKNOWN = math.nan


@dataclass(frozen=True, slots=True)
class Program:
    """One stimulation program as set.

    `limits_ma`: lowest and highest amplitude that the clinician allows; None where the settings state none.
    """

    enabled: bool | None
    amplitude_ma: float | None
    pulse_width_us: float | None
    limits_ma: tuple[float, float] | None = field(default=None, repr=False)


@dataclass(frozen=True, slots=True)
class Cycle:
    """Therapy that switches itself on and off: lengths in s, None where the settings do not say them in a known unit."""

    on_s: float | None
    off_s: float | None

    @property
    def pauses(self) -> bool:
        """False only where the pause is known to last 0 s."""
        return self.off_s is None or self.off_s > 0


@dataclass(frozen=True, slots=True)
class Dose:
    """Dose under constant settings.

    Attributes:
        amplitude_ma: per program, mA, 0 where it does not stimulate; NaN where the amplitude at a moment is unknown.
        share_on: share of the time in which pulses are given, 0 to 1; NaN where unknown. Energy is that share of continuous stimulation.
        programs: those that stimulate.
        why: sentences about what makes the amplitude unknown, or differ from the one that was set.
    """

    amplitude_ma: tuple[float, ...]
    share_on: float
    programs: tuple[int, ...]
    why: tuple[str, ...] = ()


def delivered_dose(
    on: bool | None, programs: Sequence[Program], cycle: Cycle | None = None, ramp_s: float | None = 0.0, since_on_s: float | None = None
) -> Dose:
    """Compute the delivered dose from everything that changes it.

    Args:
        on: whether therapy is on; None where no source says it, or the device is changing it.
        programs: of the active group, at least one where its settings are known.
        cycle: where the therapy switches itself on and off; None where it is continuous.
        ramp_s: length of the ramp (soft start) after switching on, s; None where one is set whose length is unknown.
        since_on_s: time since therapy was switched on, s; None where it was on before.

    Returns:
        Amplitudes in mA. With the therapy off they are 0. They are unknown with cycling, for its phase is in no file; within a ramp; and
        for an amplitude that the clinician's limits do not allow.
    """
    size = max(1, len(programs))
    nothing, unknown = (0.0,) * size, (UNKNOWN,) * size
    running = stimulating(programs)
    if on is False:
        return Dose(nothing, 0.0, running)
    if on is None or not programs:
        return Dose(unknown, UNKNOWN, running, ("no source tells whether therapy was on, or with which settings",))
    if all(p.enabled is None for p in programs):
        why = "no settings say which programs are enabled, or whether the therapy cycles: the amplitude is unknown"
        return Dose(unknown, UNKNOWN, running, (why,))
    if cycle is not None and cycle.pauses:
        return Dose(tuple(UNKNOWN if p in running else 0.0 for p in range(size)), _share(cycle), running, (_cycling(cycle),))
    if since_on_s is not None and (ramp_s is None or since_on_s < ramp_s):
        ramp = "therapy was just switched on, and its ramp has not ended"
        return Dose(tuple(UNKNOWN if p in running else 0.0 for p in range(size)), UNKNOWN, running, (ramp,))
    found = [_amplitude(programs[p]) if p in running else (0.0, None) for p in range(size)]
    reasons = [said for _, said in found if said]
    if len(running) > 1:
        reasons.append(f"{len(running)} programs stimulate in turn (interleaving): the dose is that of all of them")
    return Dose(tuple(amplitude for amplitude, _ in found), 1.0, running, tuple(reasons))


def stimulating(programs: Sequence[Program]) -> tuple[int, ...]:
    """List the enabled programs; the first one where the settings say of none whether it is enabled."""
    enabled = [p.enabled for p in programs]
    if enabled and all(value is None for value in enabled):
        return (0,)
    return tuple(p for p, value in enumerate(enabled) if value)


def _amplitude(program: Program) -> tuple[float, str | None]:
    """Compute the amplitude of a program that stimulates, mA, and why it is unknown."""
    amplitude = program.amplitude_ma
    if amplitude is None:
        return UNKNOWN, "the settings or the log state no amplitude that can be read"
    if not 0 <= amplitude < UPPER_PLAUSIBLE_MA:
        return UNKNOWN, f"{amplitude:g} mA is stated, which is a sign for no amplitude: it is unknown"
    highest = program.limits_ma[1] if program.limits_ma else 0.0
    if highest > 0 and amplitude > highest + LIMIT_TOLERANCE_MA:
        return UNKNOWN, f"{amplitude:g} mA is set where the clinician's limits allow {highest:g} mA at most"
    return amplitude, None


def _share(cycle: Cycle) -> float:
    if cycle.on_s is None or cycle.off_s is None or cycle.on_s + cycle.off_s <= 0:
        return UNKNOWN
    return cycle.on_s / (cycle.on_s + cycle.off_s)


def _cycling(cycle: Cycle) -> str:
    spans = ((cycle.on_s, "on"), (cycle.off_s, "off"))
    lengths = ", ".join(f"{word} for an unknown time" if s is None else f"{s:g} s {word}" for s, word in spans)
    return f"the therapy cycles ({lengths}): the amplitude at a moment is unknown, for the phase is in no file"
