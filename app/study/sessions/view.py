"""Content of a session's page: the chosen trace against the amplitude, each recording with its quality, the files behind the QoCs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from sqlalchemy.orm import Session

from app.platform.errors import Invalid
from app.platform.web.charts import Chart
from app.study import repository
from app.study.outcomes import service as outcomes
from app.study.outcomes import values as outcome_values
from app.study.outcomes.charts import grasp_chart, tremor_chart
from app.study.outcomes.service import Disagreement
from app.study.outcomes.values import Derived, GraspOutcome, TremorOutcome
from app.study.recordings.charts import Stretch, clock_chart, spectrum_charts, trace_charts, trace_name
from app.study.recordings.facts import (
    SensingConfiguration,
    StreamQuality,
    adaptive_states,
    amplitude_limits,
    clock_words,
    leads,
    quality_remarks,
    quality_rows,
    sensing_configurations,
    valid_shares,
)
from app.study.sessions.charts import control_chart
from app.study.sessions.usable_steps import SessionData
from app.study.traces import AMPLITUDE_STREAM, driving, session_offset_s, shown_table
from app.tables.recordings import Recording, Trace
from app.tables.sessions import StudySession


@dataclass(frozen=True)
class TraceView:
    """The main chart, and the traces that it can show.

    Attributes:
        data, chart: of the trace that is shown; None where there is nothing to draw.
        is_control: whether it is the trace that the controller saw.
        options: id and name of every trace that can be shown. shown: id of the one that is.
        used: ids of the traces in the chart. problem: why a trace that was asked for is not shown.
    """

    data: SessionData | None
    chart: Chart | None
    is_control: bool
    options: list[tuple[int, str]]
    shown: int | None
    used: set[int] = field(default_factory=set)
    problem: str = ""


@dataclass(frozen=True)
class RecordingBlock:
    """One recording of the session: of one device, under one clock.

    Attributes:
        is_control: whether the controller saw it. part: which part of it belongs to the session.
        clock: what its times rest on. quality: a row per stream. limits: where, and from to in mA.
        clock_chart: the PC's clock against the device's ticks.
        valid: share of valid windows per trace, 0 to 1. amplitude_from: the device's log that the delivered amplitude was read from.
        sensing: configurations within the recording. states: time (s) and number of each adaptive state. leads: where they are.
    """

    recording: Recording
    is_control: bool
    part: str
    clock: str
    charts: list[Chart]
    spectra: list[Chart]
    quality: list[StreamQuality]
    clock_chart: Chart | None
    remarks: list[tuple[str, str]]
    limits: list[tuple[str, str]]
    valid: dict[str, float]
    amplitude_from: str
    sensing: list[SensingConfiguration]
    states: list[tuple[float, int]]
    leads: str


@dataclass(frozen=True)
class OutcomesView:
    """The files behind the QoCs. `derived` and `clashes` as `app.study.outcomes.service` has them."""

    tremor: TremorOutcome | None
    tremor_chart: Chart | None
    grasp: GraspOutcome | None
    grasp_chart: Chart | None
    derived: list[Derived]
    clashes: list[Disagreement]
    uploads: Mapping[int, int]

    def named(self, derived: Derived) -> str:
        """List the numbers of the uploads that a value rests on."""
        return ", ".join(str(u) for u in sorted({self.uploads[i] for i in derived.upload_file_ids}))


def shown_trace(session: StudySession, data: SessionData | None, traces: Mapping[int, Sequence[Trace]], wanted: str) -> TraceView:
    """Return the trace that a page requests by its number, else the one that the controller saw."""
    settings = session.visit.participant.current_settings
    drawable = [t for rows in traces.values() for t in rows if t.stream != AMPLITUDE_STREAM and abs(t.dt_s - settings.period_s) < 1e-6]
    many = len(traces) > 1
    options = [(t.id, f"{trace_name(t)}, {t.unit}" + (f", {_whose(t.recording)}" if many else "")) for t in drawable]
    control = data.table.beta_trace if data else None
    chosen = next((t for t in drawable if str(t.id) == wanted), None)
    if chosen is None or (control is not None and chosen.id == control.id):
        has_any = data is not None and (control is not None or data.table.amplitude_trace is not None)
        chart = control_chart(data) if data is not None and has_any else None
        return TraceView(data, chart, True, options, control.id if control else None, _ids(data))
    amplitude = driving(session, traces[chosen.recording_id])
    try:
        other = SessionData(session, settings, shown_table(session, settings, chosen, amplitude))
    except Invalid as error:
        return replace(shown_trace(session, data, traces, ""), problem=f"{trace_name(chosen)}: {error}")
    return TraceView(other, control_chart(other), False, options, chosen.id, _ids(other))


def recording_blocks(
    session: StudySession, recordings: Sequence[Recording], traces: Mapping[int, Sequence[Trace]], used: set[int]
) -> list[RecordingBlock]:
    """List all recordings of a session, the one that the controller saw first."""
    settings = session.visit.participant.current_settings
    blocks = []
    for recording in recordings:
        parts = [s for s in session.segments if s.recording_id == recording.id]
        stretch = Stretch(session_offset_s(session, recording.id), -settings.window * settings.period_s, session.duration_s)
        rest = [t for t in traces[recording.id] if t.id not in used]
        origin = {str(t.details["origin"]) for t in traces[recording.id] if t.stream == AMPLITUDE_STREAM and t.details.get("origin")}
        blocks.append(
            RecordingBlock(
                recording=recording,
                is_control=any(s.is_control for s in parts),
                part="; ".join(f"{s.start_s:.0f} to {s.stop_s:.0f} s" for s in parts) + f" of {recording.duration_s:.0f} s",
                clock=clock_words(recording),
                charts=trace_charts(recording, rest, stretch),
                spectra=spectrum_charts(recording, settings.beta_low_hz, settings.beta_high_hz),
                quality=quality_rows(recording),
                clock_chart=clock_chart(recording),
                remarks=quality_remarks(recording),
                limits=amplitude_limits(recording),
                valid=valid_shares(recording),
                amplitude_from=", ".join(sorted(origin)),
                sensing=sensing_configurations(recording),
                states=adaptive_states(recording),
                leads=leads(recording),
            )
        )
    return sorted(blocks, key=lambda b: not b.is_control)


def outcomes_view(db: Session, session: StudySession) -> OutcomesView:
    """Collect the session's QoCs from the uploaded files."""
    tremor, grasp = outcome_values.tremor_outcome(db, session), outcome_values.grasp_outcome(db, session)
    derived = [o.derived for o in (grasp, tremor) if o is not None]
    files = [*(tremor.minutes.upload_file_ids if tremor else ()), *(t.row.upload_file_id for t in (grasp.tests if grasp else ()))]
    uploads = repository.uploads_of_files(db, files)
    return OutcomesView(
        tremor,
        tremor_chart(tremor, uploads) if tremor else None,
        grasp,
        grasp_chart(grasp) if grasp and any(t.intervals_s.size for t in grasp.tests) else None,
        derived,
        outcomes.disagreements(session, derived),
        uploads,
    )


def _whose(recording: Recording) -> str:
    return recording.hemisphere or f"recording {recording.id}"


def _ids(data: SessionData | None) -> set[int]:
    return {t.id for t in (data.table.beta_trace, data.table.amplitude_trace) if t} if data else set()
