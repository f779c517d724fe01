"""Energy of every controller by several measures, and the range of a battery's life."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis.energy.measures import Measure, Pulses, Taken, mean, pulses_of, taken
from app.analysis.energy.schemas import ImplantIn
from app.analysis.evidence import repository
from app.analysis.evidence.facts import Facts
from app.analysis.evidence.service import Evidence, evidence
from app.platform.errors import Invalid
from app.platform.kept import kept
from app.study.blinding import CONTROLLER_NAMES
from app.tables.participants import Participant
from app.tables.sessions import Controller
from ml.energy import Implant, Range, saving_percent

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
    """The measures of every session and their means by controller."""
    held = evidence(db, participant, caller)

    def compute() -> Energy:
        pulses = _pulses(db, held)
        sessions = tuple(taken(s, pulses.get(s.session_id, {}), impedance_ohm) for s in held.sessions)
        present = [c for c in Controller if any(s.controller is c for s in held.sessions)]
        rows = [_row(m, c, sessions) for m in Measure for c in present if m is not Measure.TEED or impedance_ohm is not None]
        return Energy(participant.code, tuple(rows), sessions, sum(t.unknown_sides for t in sessions))

    return kept(("energy", held.key, impedance_ohm), compute)


def battery(found: Energy, stated: ImplantIn) -> list[BatteryRow]:
    """Days of one charge if a controller ran all the time, at the mean and mean square of its amplitude fraction.

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
    """None where no session of the controller has an amplitude."""
    mine = [t for t in found.sessions if t.session.controller is controller and {Measure.SQUARE, Measure.AMPLITUDE} <= t.values.keys()]
    square, amplitude = (mean([t.values[m] for t in mine]) for m in (Measure.SQUARE, Measure.AMPLITUDE))
    if square is None or amplitude is None:
        return None
    least, most = implant.life([cdbs_ma * square**0.5]).days, implant.life([cdbs_ma * amplitude]).days
    days = Range(min(least.low, most.low), max(least.high, most.high))
    return BatteryRow(controller, CONTROLLER_NAMES[controller], days, tuple(t.session.session_id for t in mine))


def _implant(stated: ImplantIn) -> Implant:
    """Raises Invalid for a range that falls."""

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


def _pulses(db: Session, held: Evidence) -> dict[int, Mapping[tuple[int, int], Pulses]]:
    """Logged pulses by session, then by recording and program."""
    wanted = {side.recording_id for s in held.sessions for side in s.sides if side.recording_id is not None}
    events = repository.stimulation_events(db, wanted)
    spans = repository.spans(db, [s.session_id for s in held.sessions])
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
