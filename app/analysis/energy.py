"""Energy of stimulation by several measures, each with its definition, and the battery life that follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis import evidence as evidence_rules
from app.analysis.evidence import Evidence, evidence
from app.analysis.facts import Facts, Side
from app.platform.errors import Invalid
from app.platform.kept import kept
from app.platform.web.schemas import Model, Text
from app.study.blinding import CONTROLLER_NAMES
from app.tables.participants import Participant
from app.tables.sessions import Controller
from ml.energy import Implant, Range, saving_percent

# API types of the energy.

Amount = Annotated[float, Field(allow_inf_nan=False)]


class MeasureOut(Model):
    """One measure of one controller."""

    measure: str = Field(description="mean_a, mean_a2, all_sides_a2, charge_uc_per_s or teed_uw.")
    title: str
    unit: str
    definition: str
    controller: Controller
    mean: float | None = Field(description="Over its sessions; null where no session has it.")
    saved_percent: float | None = Field(description="Against the mean of the cDBS sessions.")
    session_ids: list[int]


class EnergyOut(Model):
    """Energy of stimulation, by controller and measure."""

    participant: str
    rows: list[MeasureOut]
    unknown_sides: int = Field(description="Sides and programs of sessions whose amplitude in mA, width or rate is not known.")


class ImplantIn(Model):
    """Assumptions about an implant; no recording holds them."""

    capacity_low_mah: Amount = Field(gt=0, le=1e5)
    capacity_high_mah: Amount = Field(gt=0, le=1e5)
    voltage_v: Amount = Field(gt=0, le=100)
    other_drain_uw: Amount = Field(ge=0, le=1e6)
    impedance_ohm: Amount = Field(gt=0, le=1e5)
    supply_v: Amount = Field(gt=0, le=100)
    pulse_width_us: Amount = Field(gt=0, le=1000)
    rate_hz: Amount = Field(gt=0, le=1000)
    cdbs_ma: Amount = Field(gt=0, le=25.5)
    source: Text = Field(min_length=1, max_length=300)


class BatteryIn(ImplantIn):
    """The same as a query."""

    format: Literal["json", "csv"] = "json"


class BatteryRowOut(Model):
    """Days of one charge, or of a primary cell, if one controller ran all the time."""

    controller: Controller
    days_low: float
    days_high: float
    session_ids: list[int] = Field(description="Sessions whose amplitudes it goes by.")


class BatteryOut(Model):
    """A battery's life by controller under stated assumptions."""

    participant: str
    source: str = Field(description="Where the assumptions are from.")
    rows: list[BatteryRowOut]


# Measures of the stimulation of a session, over all its sides and programs where their pulses are logged. No database.
#
# With current I (A), pulse width w (s), rate f (Hz) and impedance R (ohm): charge per second is I w f. Total electrical energy delivered
# per second is I^2 R w f (Koss et al. 2005, for currents). Each is summed over sides and programs. Relative to cDBS both are shares of what
# the cDBS amplitude would have taken with the same pulses.


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
    """Energy of one session, by measure, absent where not known; `unknown_sides` have no logged width or rate or amplitude in mA."""

    session: Facts
    values: Mapping[Measure, float]
    unknown_sides: int


def pulses_of(events: Sequence[Mapping[str, object]], program: int, start_s: float, stop_s: float) -> Pulses:
    """Find the pulses of a program over a stretch of a recording, from its logged states of stimulation in time order.

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
    """Compute the measures of one session.

    Args:
        pulses: by recording and program. impedance_ohm: of the therapy contacts, None where not stated.
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
    """Compute the energy of all sides and programs relative to their cDBS amplitudes; with one side its mean a^2, whatever its pulses.

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
    """Return width and rate of a side whose amplitude in mA is known too; without any current they do not matter."""
    if side.milliamperes == 0:
        return 0.0, 0.0
    width, rate = _pulses(side, pulses)
    return None if width is None or rate is None or side.milliamperes is None else (width, rate)


def _pulses(side: Side, pulses: Mapping[tuple[int, int], Pulses]) -> tuple[float | None, float | None]:
    """Look up width (us) and rate (Hz) of a side's program, None where not known."""
    found = pulses.get((side.recording_id or 0, side.program), Pulses(None, None))
    return found.width_us, found.rate_hz


def mean(values: Sequence[float]) -> float | None:
    """Average over sessions; None without any."""
    return float(np.mean(values)) if values else None


def _t(event: Mapping[str, object]) -> float:
    value = event.get("t_s")
    return float(value) if isinstance(value, int | float) else 0.0


def _state(event: Mapping[str, object], program: int) -> tuple[float | None, float | None] | None:
    """Return width and rate of a program in one state; None where it does not stimulate there."""
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


# Energy of every controller by several measures, and the range of a battery's life.

RELATIVE = (Measure.AMPLITUDE, Measure.SQUARE, Measure.ALL_SIDES)


@dataclass(frozen=True)
class MeasureRow:
    """One measure of one controller.

    Attributes:
        mean: over its sessions that have it, n of them, with their numbers. saved_percent: against the mean of cDBS.
    """

    measure: Measure
    controller: Controller
    label: str
    mean: float | None
    saved_percent: float | None
    session_ids: tuple[int, ...]


@dataclass(frozen=True)
class BatteryRow:
    """Days of one charge under a controller, a range."""

    controller: Controller
    label: str
    days: Range
    session_ids: tuple[int, ...]


@dataclass(frozen=True)
class Energy:
    """Energy of one participant; `unknown_sides` counts sides and programs without logged pulses or mA, over all sessions."""

    participant: str
    rows: tuple[MeasureRow, ...]
    sessions: tuple[Taken, ...]
    unknown_sides: int


def energy(db: Session, participant: Participant, caller: Caller, impedance_ohm: float | None = None) -> Energy:
    """Compute the measures of every session and their means by controller."""
    held = evidence(db, participant, caller)

    def compute() -> Energy:
        pulses = _pulses_of_sessions(db, held)
        sessions = tuple(taken(s, pulses.get(s.session_id, {}), impedance_ohm) for s in held.sessions)
        present = [c for c in Controller if any(s.controller is c for s in held.sessions)]
        rows = [_row(m, c, sessions) for m in Measure for c in present if m is not Measure.TEED or impedance_ohm is not None]
        return Energy(participant.code, tuple(rows), sessions, sum(t.unknown_sides for t in sessions))

    return kept(("energy", held.key, impedance_ohm), compute)


def battery(found: Energy, stated: ImplantIn) -> list[BatteryRow]:
    """Estimate the days of one charge if a controller ran all the time, at the mean and mean square of its amplitude fraction.

    Args:
        found: the energy. stated: assumptions about the implant.

    Raises:
        Invalid: a range that falls, or assumptions from which no life follows.
    """
    implant = _implant(stated)
    try:
        return [row for c in Controller if (row := _life(found, implant, c, stated.cdbs_ma)) is not None]
    except ValueError as error:
        raise Invalid(f"No life follows from these assumptions: {error}.", "State all other drain of the implant, above 0.") from error


def _life(found: Energy, implant: Implant, controller: Controller, cdbs_ma: float) -> BatteryRow | None:
    """Estimate the battery life under one controller; None where no session of the controller has an amplitude."""
    mine = [t for t in found.sessions if t.session.controller is controller and {Measure.SQUARE, Measure.AMPLITUDE} <= t.values.keys()]
    square, amplitude = (mean([t.values[m] for t in mine]) for m in (Measure.SQUARE, Measure.AMPLITUDE))
    if square is None or amplitude is None:
        return None
    least, most = implant.life([cdbs_ma * square**0.5]).days, implant.life([cdbs_ma * amplitude]).days
    days = Range(min(least.low, most.low), max(least.high, most.high))
    return BatteryRow(controller, CONTROLLER_NAMES[controller], days, tuple(t.session.session_id for t in mine))


def _implant(stated: ImplantIn) -> Implant:
    """Build the implant from the stated assumptions. Raises Invalid for a range that falls."""

    def exactly(value: float) -> Range:
        return Range(value, value)

    try:
        return Implant(
            capacity_mah=Range(stated.capacity_low_mah, stated.capacity_high_mah),
            voltage_v=exactly(stated.voltage_v),
            other_drain_uw=exactly(stated.other_drain_uw),
            impedance_ohm=exactly(stated.impedance_ohm),
            supply_v=exactly(stated.supply_v),
            pulse_width_us=exactly(stated.pulse_width_us),
            rate_hz=exactly(stated.rate_hz),
            source=stated.source,
        )
    except ValueError as error:
        raise Invalid(f"These assumptions do not fit together: {error}.", "Give the smaller capacity first.") from error


def _row(measure: Measure, controller: Controller, sessions: Sequence[Taken]) -> MeasureRow:
    mine = [t for t in sessions if t.session.controller is controller and measure in t.values]
    cdbs = mean([t.values[measure] for t in sessions if t.session.controller is Controller.CDBS and measure in t.values])
    own = mean([t.values[measure] for t in mine])
    saved = saving_percent(own, cdbs) if own is not None and cdbs and controller is not Controller.CDBS else None
    return MeasureRow(measure, controller, CONTROLLER_NAMES[controller], own, saved, tuple(t.session.session_id for t in mine))


def _pulses_of_sessions(db: Session, held: Evidence) -> dict[int, Mapping[tuple[int, int], Pulses]]:
    """Collect logged pulses by session, then by recording and program."""
    wanted = {side.recording_id for s in held.sessions for side in s.sides if side.recording_id is not None}
    events = evidence_rules.stimulation_events(db, wanted)
    spans = evidence_rules.spans(db, [s.session_id for s in held.sessions])
    return {s.session_id: _of_session(s, events, spans) for s in held.sessions}


def _of_session(
    session: Facts, events: Mapping[int, Sequence[Mapping[str, object]]], spans: Mapping[tuple[int, int], tuple[float, float]]
) -> Mapping[tuple[int, int], Pulses]:
    found = {}
    for side in session.sides:
        span = spans.get((session.session_id, side.recording_id or 0))
        if side.recording_id is not None and span is not None:
            found[(side.recording_id, side.program)] = pulses_of(events.get(side.recording_id, []), side.program, *span)
    return found


# What each measure of energy is, in words next to its number.

SHARES = {Measure.AMPLITUDE, Measure.SQUARE, Measure.ALL_SIDES}
"""Measures that are shares of what cDBS takes: pages show them in % of cDBS, files and the API as they are."""

MEASURES: dict[Measure, tuple[str, str, str]] = {
    Measure.AMPLITUDE: (
        "Mean amplitude", "share of cDBS", "Mean over the session's steps of a, the share of the cDBS amplitude, on the controlled side.",
    ),
    Measure.SQUARE: (
        "Mean squared amplitude", "share of cDBS",
        "Mean over the session's steps of a² on the controlled side: its energy at the pulse width and rate of cDBS. Every page that "
        "speaks of energy uses this.",
    ),
    Measure.ALL_SIDES: (
        "Energy of all sides and programs", "share of cDBS",
        "Sum over sides and programs of mean I² · w · f, over the same sum at their cDBS amplitudes; width w and rate f as recorded. "
        "With one side and program the mean of a².",
    ),
    Measure.CHARGE: (
        "Charge", "µC/s", "Sum over sides and programs of mean I · w · f, with width w and rate f as recorded; only where all are known.",
    ),
    Measure.TEED: (
        "Total electrical energy delivered", "µW",
        "Sum over sides and programs of mean I² · R · w · f (Koss et al. 2005, for currents), with the impedance R that you stated "
        "for all contacts: no recording here names that of the contacts in use.",
    ),
}  # fmt: skip
"""Title, unit and definition."""
