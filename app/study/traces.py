"""Traces in and out of the database, and the step table of a session: beta and amplitude on one 2 s grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.platform.errors import Invalid
from app.platform.numbers import stated
from app.study import cdbs_amplitude, repository
from app.tables.participants import SettingsVersion
from app.tables.recordings import Recording, Trace
from app.tables.sessions import StudySession
from ml.formats.beta import ERROR_STREAM
from ml.mdp import AMPLITUDE_TOLERANCE

AMPLITUDE_STREAM = "amplitude"
NO_CONTROL = frozenset({AMPLITUDE_STREAM, ERROR_STREAM})
"""Streams that no controller can have seen."""

MOST_STEPS = 1_000_000
"""Steps of a session that are laid out: at 2 s three weeks. A session of more has a wrong begin or end."""
AnyTrace = TypeVar("AnyTrace", Trace, repository.TraceHead)


@dataclass(frozen=True)
class StepTable:
    """Rows of one session on the control grid; row i ends `t_s[i]` seconds after the session's start (`t_s` <= 0: before it).

    Attributes:
        t_s: end of each row, seconds, multiples of the period, shape [n].
        beta: beta amplitude, shape [n]; NaN where invalid.
        amplitude_ma: milliamperes, shape [n]; NaN where unknown or where the source gave fractions and no cDBS amplitude is known.
        fraction: amplitude fraction of the cDBS amplitude in force, shape [n]; NaN where unknown. May exceed 1.
        beta_trace, amplitude_trace: the rows of `trace` that it was read from; None where the session has none.
        cdbs_ma: the cDBS amplitude in force, mA, or None where not stated.
    """

    t_s: NDArray[np.float64]
    beta: NDArray[np.float64]
    amplitude_ma: NDArray[np.float64]
    fraction: NDArray[np.float64]
    beta_trace: Trace | None
    amplitude_trace: Trace | None
    cdbs_ma: float | None

    @property
    def above_one(self) -> int:
        """Steps of the session whose amplitude exceeds the cDBS amplitude: flagged, never clipped, kept out of buffers."""
        return int(np.sum(self.fraction[self.t_s > 0] > 1 + AMPLITUDE_TOLERANCE))


def pack(values: NDArray[np.floating], valid: NDArray[np.bool_]) -> tuple[bytes, bytes]:
    """Pack the columns `values_f32` and `valid_bits` of a trace."""
    return values.astype("<f4").tobytes(), np.packbits(valid).tobytes()


def unpack(trace: Trace) -> NDArray[np.float64]:
    """Unpack the values of a trace, shape [n], NaN where invalid."""
    values = np.frombuffer(trace.values_f32, dtype="<f4").astype(np.float64)
    valid = np.unpackbits(np.frombuffer(trace.valid_bits, dtype=np.uint8), count=trace.n)
    if not valid.all():
        values[valid == 0] = np.nan
    return values


TracesOf = Callable[[int], Sequence[Trace]]
"""The traces of a recording, by its number, in their newest decode version."""


def traces_of(db: Session, sessions: Sequence[StudySession]) -> TracesOf:
    """Load the traces of all recordings of these sessions at once; read only and without details."""
    found = repository.traces_of_recordings(db, {g.recording_id for s in sessions for g in s.segments})
    return lambda recording_id: found.get(recording_id, [])


def step_table(db: Session, session: StudySession, settings: SettingsVersion) -> StepTable:
    """Build beta and amplitude of a session's control channel, with up to W rows before its start; errors as in `laid_out`."""
    return laid_out(session, settings, lambda recording_id: repository.traces_of_recording(db, recording_id))


def laid_out(session: StudySession, settings: SettingsVersion, traces: TracesOf) -> StepTable:
    """Build the step table from traces that are already loaded.

    Raises:
        Invalid: a session of more than MOST_STEPS, traces of one recording that do not share a grid, or two segments that claim the same
            rows.
    """
    period, t_s = settings.period_s, _grid(session, settings)
    beta, amount = np.full(t_s.size, np.nan), np.full(t_s.size, np.nan)
    beta_trace = amplitude_trace = None
    beside: Sequence[Trace] = ()
    for segment in session.segments:
        if not segment.is_control:
            continue
        own = traces(segment.recording_id)
        found, given = _chosen(session, own)
        origin = session_offset_s(session, segment.recording_id)
        if found is not None:
            _place(beta, t_s, found, origin, period)
            beta_trace = found
        if given is not None:
            _place(amount, t_s, given, origin, period)
            amplitude_trace, beside = given, own
    cdbs = _cdbs(session, settings, amplitude_trace, beside)
    return _table(t_s, beta, amount, beta_trace, amplitude_trace, cdbs)


@dataclass(frozen=True)
class Sources:
    """Sources of a session's step table; the numbers of its traces and the cDBS amplitude in force, mA."""

    beta_trace_id: int | None
    amplitude_trace_id: int | None
    cdbs_ma: float | None


def sources(session: StudySession, settings: SettingsVersion, heads: Mapping[int, Sequence[repository.TraceHead]]) -> Sources:
    """Find what `step_table` would read now; no trace is read for it.

    Args:
        session, settings: as for `step_table`. heads: of `repository.trace_heads`, by recording.

    Raises:
        Invalid: as `app.study.cdbs_amplitude.stated_at`.
    """
    beta: repository.TraceHead | None = None
    amplitude: repository.TraceHead | None = None
    beside: Sequence[repository.TraceHead] = ()
    for segment in session.segments:
        if segment.is_control:
            own = heads.get(segment.recording_id, [])
            found, given = _chosen(session, own)
            beta = found or beta
            amplitude, beside = (given, own) if given else (amplitude, beside)
    cdbs = _cdbs(session, settings, amplitude, beside)
    return Sources(beta.id if beta else None, amplitude.id if amplitude else None, cdbs)


def shown_table(
    session: StudySession,
    settings: SettingsVersion,
    trace: Trace,
    amplitude: Trace | None,
    recording: Recording | None = None,
    alone: bool = True,
) -> StepTable:
    """Place any trace of a session's recordings on the session's grid, with an amplitude of the same recording; `beta` holds its values.

    `recording` is the trace's own, where the caller has it at hand. `alone`: its recording has no other program's amplitude.

    The cDBS amplitude is that of the trace's own side and of the amplitude's program.

    Raises:
        Invalid: a trace that is not on the participant's grid, or a visit that states both sides and a recording that names none.
    """
    program = amplitude_program(amplitude) if amplitude is not None else 0
    cdbs = cdbs_amplitude.in_force(session.visit, (recording or trace.recording).hemisphere or session.hemisphere, settings, program, alone)
    t_s = _grid(session, settings)
    beta, amount = np.full(t_s.size, np.nan), np.full(t_s.size, np.nan)
    origin = session_offset_s(session, trace.recording_id)
    _place(beta, t_s, trace, origin, settings.period_s)
    if amplitude is not None:
        _place(amount, t_s, amplitude, origin, settings.period_s)
    return _table(t_s, beta, amount, trace, amplitude, cdbs)


def beta_of_part(trace: Trace, settings: SettingsVersion, start_s: float, stop_s: float) -> NDArray[np.float64]:
    """Place a trace between two times of its recording on the grid of steps, with the W rows before, shape [W + T]; NaN where invalid.

    Raises:
        Invalid: a part of more than MOST_STEPS, or a trace that is not on the participant's grid.
    """
    t_s = _rows(f"The part from {stated(start_s, 9)} s", stop_s - start_s, settings)
    beta = np.full(t_s.size, np.nan)
    _place(beta, t_s, trace, start_s, settings.period_s)
    return beta


@dataclass(frozen=True)
class RecordedTrace:
    """One trace within a session: ends of its rows, s from the session's start, and values with NaN where invalid, both [n]."""

    trace: Trace
    is_control: bool
    t_s: NDArray[np.float64]
    values: NDArray[np.float64]


def recorded_traces(db: Session, session: StudySession, settings: SettingsVersion) -> list[RecordedTrace]:
    """List every trace of every recording of a session, the control recording first, from the state window before the session on.

    Rows stay where the recording has them; the grid of the session's steps is not asked.
    """
    found = []
    lead = settings.window * settings.period_s
    for recording_id in dict.fromkeys(s.recording_id for s in sorted(session.segments, key=lambda s: (not s.is_control, s.start_s))):
        traces = repository.traces_of_recording(db, recording_id)
        control = any(s.is_control and s.recording_id == recording_id for s in session.segments)
        seen = _chosen(session, traces)[0] if control else None
        origin = session_offset_s(session, recording_id)
        for trace in traces:
            t_s = trace.first_end_s - origin + trace.dt_s * np.arange(trace.n, dtype=np.float64)
            inside = (t_s > -lead + 1e-6) & (t_s <= session.duration_s + trace.dt_s / 2)
            found.append(RecordedTrace(trace, trace is seen, t_s[inside], unpack(trace)[inside]))
    return found


def amplitude_program(trace: Trace | repository.TraceHead) -> int:
    """Return the stimulation program of an amplitude trace; 0 where it names none."""
    word, _, number = trace.channel.rpartition(" ")
    return int(number) if word == "program" and number.isdecimal() else 0


def _grid(session: StudySession, settings: SettingsVersion) -> NDArray[np.float64]:
    """Return the ends of the session's rows, with W rows before its start, s. Raises Invalid for a session of more than MOST_STEPS."""
    return _rows(f"Session {session.id}", session.duration_s, settings)


def _rows(named: str, duration_s: float, settings: SettingsVersion) -> NDArray[np.float64]:
    steps = int(np.floor(duration_s / settings.period_s + 1e-6))
    if steps > MOST_STEPS:
        raise Invalid(
            f"{named} is stated to last {stated(duration_s, 9)} s: {steps} steps of {stated(settings.period_s)} s, "
            f"where {MOST_STEPS} are the most.",
            "Exclude it, or drop its proposal. Send a table whose times are Unix times again, with seconds from the session's start.",
        )
    return settings.period_s * np.arange(-settings.window + 1, steps + 1, dtype=np.float64)


def _table(
    t_s: NDArray[np.float64],
    beta: NDArray[np.float64],
    amount: NDArray[np.float64],
    beta_trace: Trace | None,
    amplitude_trace: Trace | None,
    cdbs: float | None,
) -> StepTable:
    unknown = np.full(t_s.size, np.nan)
    if amplitude_trace is not None and amplitude_trace.unit == "fraction":
        milliamperes, fraction = amount * cdbs if cdbs else unknown, amount
    else:
        milliamperes, fraction = amount, amount / cdbs if cdbs else unknown
    return StepTable(t_s, beta, milliamperes, fraction, beta_trace, amplitude_trace, cdbs)


def session_offset_s(session: StudySession, recording_id: int) -> float:
    """Return the session's start in a recording's clock, seconds: the start of its first segment in that recording."""
    return min(s.start_s for s in session.segments if s.recording_id == recording_id)


def _chosen(session: StudySession, traces: Sequence[AnyTrace]) -> tuple[AnyTrace | None, AnyTrace | None]:
    """Choose the trace of the session's control channel and that of its amplitude, among those of one recording."""
    candidates = [t for t in traces if t.stream == session.control_stream]
    if session.control_channel is not None:
        candidates = [t for t in candidates if t.channel == session.control_channel]
    return candidates[0] if candidates else None, driving(session, traces)


def driving(session: StudySession, traces: Sequence[AnyTrace]) -> AnyTrace | None:
    """Return the amplitude that the session's controller set, among the traces of one recording."""
    amplitudes = [t for t in traces if t.stream == AMPLITUDE_STREAM]
    return next((t for t in amplitudes if session.control_program in (None, amplitude_program(t))), None)


def control_programs(db: Session, session: StudySession) -> list[int]:
    """List programs whose amplitude the session's control recordings hold."""
    control = {s.recording_id for s in session.segments if s.is_control}
    return sorted({amplitude_program(t) for i in control for t in repository.traces_of_recording(db, i) if t.stream == AMPLITUDE_STREAM})


def _cdbs(session: StudySession, settings: SettingsVersion, amplitude: AnyTrace | None, traces: Sequence[AnyTrace]) -> float | None:
    """Return the reference of the controlled amplitude, mA; with other programs only what is stated of this one. Raises Invalid."""
    alone = sum(t.stream == AMPLITUDE_STREAM for t in traces) <= 1
    return cdbs_amplitude.of_session(session, settings, amplitude_program(amplitude) if amplitude else 0, alone)


def _place(into: NDArray[np.float64], t_s: NDArray[np.float64], trace: Trace, origin_s: float, period_s: float) -> None:
    """Write a trace's rows onto the session's grid; a trace whose rows end off the grid is moved to the nearest grid row."""
    if abs(trace.dt_s - period_s) > 1e-6:
        raise Invalid(
            f"Trace '{trace.stream}' has rows of {trace.dt_s:g} s, the participant's period is {period_s:g} s.",
            "Set the participant's period_s to the device's, or decode the recording again.",
        )
    values = unpack(trace)
    if trace.dt_s == period_s:  # nearly every trace: its rows lie side by side on the grid
        first = round((trace.first_end_s - origin_s - float(t_s[0])) / period_s)
        begin, end = max(first, 0), min(first + trace.n, t_s.size)
        if begin < end:
            into[begin:end] = values[begin - first : end - first]
        return
    rows = np.rint((trace.first_end_s - origin_s + trace.dt_s * np.arange(trace.n) - t_s[0]) / period_s).astype(int)
    inside = (rows >= 0) & (rows < t_s.size)
    into[rows[inside]] = values[inside]
