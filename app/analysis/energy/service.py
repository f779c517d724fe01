"""Energy of every controller by several measures, and the range of a battery's life."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis.energy.measures import Measure, Pulses, Taken, mean, pulses_of, taken
from app.analysis.evidence import repository
from app.analysis.evidence.facts import Facts
from app.analysis.evidence.service import Evidence, evidence
from app.platform.kept import kept
from app.study.blinding import CONTROLLER_NAMES
from app.study.models import Controller, Participant
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


def battery(found: Energy, implant: Implant, cdbs_ma: float) -> list[BatteryRow]:
    """Days of one charge if a controller ran all the time, at the mean and mean square of its amplitude fraction.

    Args:
        found: the energy. implant: assumptions about the implant. cdbs_ma: amplitude of cDBS, mA.

    Raises:
        ValueError: numbers from which no life follows.
    """
    rows = []
    for controller in Controller:
        mine = [t for t in found.sessions if t.session.controller is controller]
        squares = [t.values[Measure.SQUARE] for t in mine if Measure.SQUARE in t.values]
        means = [t.values[Measure.AMPLITUDE] for t in mine if Measure.AMPLITUDE in t.values]
        if squares and means:
            least = implant.life([cdbs_ma * (sum(squares) / len(squares)) ** 0.5]).days
            most = implant.life([cdbs_ma * sum(means) / len(means)]).days
            rows.append(BatteryRow(controller, CONTROLLER_NAMES[controller], Range(min(least.low, most.low), max(least.high, most.high))))
    return rows


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
