"""Facts that one session contributes: its metrics, missing ones with the reason, and the stimulation of all its sides. No database."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from app.platform.errors import Invalid
from app.study.blinding import Arm
from app.study.doses import hours_since_dose
from app.study.sessions.stimulation import delivered_by
from app.study.sessions.usable_steps import qoc_of
from app.study.traces import AMPLITUDE_STREAM, StepTable, TracesOf, amplitude_program, laid_out
from app.tables.recordings import Trace
from app.tables.sessions import Controller, StudySession
from ml.energy import mean_square_ma, relative_energy
from ml.outcomes import KEYS, OUTCOMES
from ml.statistics.within_visits.contrasts import Measurements

KNOWN_SHARE = 0.5
"""Share of a session's steps that must be known for its energy and its mean beta to describe the session (ours)."""

METRICS = ("energy", "mean_beta", *KEYS)
"""The paper's five metrics, in its order."""


class Missing(StrEnum):
    """Reason why a session has no value of a metric."""

    NOT_ENTERED = "not_entered"
    NO_TRACE = "no_trace"
    MOSTLY_UNKNOWN = "mostly_unknown"
    NO_CDBS_AMPLITUDE = "no_cdbs_amplitude"
    OTHER_BETA = "other_beta"


class LeftOut(StrEnum):
    """Reason why a session counts in no analysis."""

    EXCLUDED = "excluded"
    NOT_CONFIRMED = "not_confirmed"
    UNREADABLE = "unreadable"
    HIDDEN = "hidden"
    SEALED = "sealed"
    """Of a blinded plan whose key is sealed."""


@dataclass(frozen=True)
class BetaKind:
    """Unit and source of beta: amplitudes are comparable where both are equal."""

    unit: str
    source: str


@dataclass(frozen=True)
class Side:
    """Stimulation of one side and program over a session's known steps; None where not known.

    Attributes:
        name: of the side, for a table. recording_id, program: where its pulses are looked up. is_control: the side that was controlled.
        fraction, square: means of the amplitude fraction and of its square. milliamperes, square_ma2: the same in mA and mA^2.
        cdbs_ma: the cDBS amplitude in force for it.
    """

    name: str
    recording_id: int | None
    program: int
    is_control: bool
    fraction: float | None
    square: float | None
    milliamperes: float | None
    square_ma2: float | None
    cdbs_ma: float | None = None


@dataclass(frozen=True)
class Facts:
    """One session that counts.

    Attributes:
        values: by metric, absent where not measured. missing: why, by metric. steps: shares of usable beta and amplitude are taken of them.
        stopped: it was stopped for the patient's sake, for the reason given.
        late_stop: so, but known only after its visit was locked; it counts as measured. medication_h: hours since the last dose, where
            known.
        created_at: when the record of the session came into being. visit_date: of its visit, where stated.
        policy_share: of its decisions that followed policy or schedule; None without a log.
    """

    session_id: int
    visit: int
    visit_id: int
    ordinal: int
    arm: Arm
    hemisphere: str | None
    started_at: datetime | None
    created_at: datetime
    duration_s: float
    values: Mapping[str, float]
    missing: Mapping[str, Missing]
    beta_kind: BetaKind | None
    mean_fraction: float | None
    sides: tuple[Side, ...]
    stopped: str | None
    medication_h: float | None
    visit_date: date | None = None
    late_stop: bool = False
    policy_share: float | None = None

    def began_after(self, moment: datetime) -> bool:
        """Return whether the session is known to have begun after a moment: by its start, else by the day of its visit."""
        if self.started_at is not None:
            return self.started_at > moment
        return self.visit_date is not None and self.visit_date > moment.date()

    @property
    def controller(self) -> Controller:
        return self.arm.controller


@dataclass(frozen=True)
class Excluded:
    """Session that is excluded from the analyses altogether.

    Attributes:
        detail: the reason given, or what could not be read. arm, duration_s: of a session that could not be read: it ran.
    """

    session_id: int
    visit: int
    ordinal: int
    why: LeftOut
    detail: str
    arm: Arm | None = None
    duration_s: float = 0.0


def read(session: StudySession, arm: Arm, traces: TracesOf, *, late_stop: bool = False, policy_share: float | None = None) -> Facts:
    """Return the facts of one session.

    Raises:
        Invalid: traces that do not fit the session's grid, or an ambiguous cDBS amplitude.
    """
    settings = session.visit.participant.current_settings
    table = laid_out(session, settings, traces)
    first, qoc = int(np.searchsorted(table.t_s, 0.0, side="right")), qoc_of(session)
    fraction, beta = _means(table.fraction[first:], relative_energy), table.beta[first:]
    found = {
        "energy": fraction.square,
        "mean_beta": _means(beta).mean,
        **{o.key: getattr(qoc, o.field) for o in OUTCOMES},
    }
    values = {name: float(value) for name, value in found.items() if value is not None and math.isfinite(value)}
    return Facts(
        session_id=session.id,
        visit=session.visit.number,
        visit_id=session.visit_id,
        ordinal=session.ordinal,
        arm=arm,
        hemisphere=session.hemisphere,
        started_at=session.started_at,
        created_at=session.created_at,
        duration_s=session.duration_s,
        values=values,
        missing={name: _why(name, table) for name in METRICS if name not in values},
        beta_kind=BetaKind(table.beta_trace.unit, table.beta_trace.source) if table.beta_trace else None,
        mean_fraction=fraction.mean,
        sides=_sides(session, table, fraction, traces),
        stopped=session.stopped_reason,
        medication_h=hours_since_dose(session),
        visit_date=session.visit.date,
        late_stop=late_stop,
        policy_share=policy_share,
    )


def _why(metric: str, table: StepTable) -> Missing:
    if metric not in ("energy", "mean_beta"):
        return Missing.NOT_ENTERED
    if (table.amplitude_trace if metric == "energy" else table.beta_trace) is None:
        return Missing.NO_TRACE
    if metric == "energy" and table.cdbs_ma is None and np.isnan(table.fraction).all():
        return Missing.NO_CDBS_AMPLITUDE
    return Missing.MOSTLY_UNKNOWN


def _sides(session: StudySession, table: StepTable, fraction: _Means, traces: TracesOf) -> tuple[Side, ...]:
    """Return every side and program that was recorded; a session of one amplitude trace has it already in its step table.

    Where another side cannot be read, it is there without numbers, so that no sum over sides passes for the whole.
    """
    if not several_sides(session, traces):
        controlled = any(_amplitudes(s.recording_id, traces) for s in session.segments if s.is_control)
        return (_side("controlled side", True, table, fraction),) if controlled else ()
    try:
        return tuple(_side(d.name, d.is_control, d.table) for d in delivered_by(session, traces) if d.table is not None)
    except Invalid:
        return (_side("controlled side", True, table, fraction), _side("other side", False, None))


def several_sides(session: StudySession, traces: TracesOf) -> bool:
    """Check whether a session has several recordings, or one with amplitudes of several programs: then its recordings are read too."""
    recordings = {s.recording_id for s in session.segments}
    return len(recordings) > 1 or sum(len(_amplitudes(i, traces)) for i in recordings) > 1


def _amplitudes(recording_id: int, traces: TracesOf) -> list[Trace]:
    return [t for t in traces(recording_id) if t.stream == AMPLITUDE_STREAM]


def _side(name: str, is_control: bool, table: StepTable | None, fraction: _Means | None = None) -> Side:
    if table is None or table.amplitude_trace is None:
        return Side(name, None, 0, is_control, None, None, None, None)
    first = int(np.searchsorted(table.t_s, 0.0, side="right"))
    of_cdbs = _means(table.fraction[first:], relative_energy) if fraction is None else fraction
    in_ma = of_cdbs.times(table.cdbs_ma) if table.cdbs_ma else _means(table.amplitude_ma[first:], mean_square_ma)
    of_trace = table.amplitude_trace
    amounts = of_cdbs.mean, of_cdbs.square, in_ma.mean, in_ma.square
    return Side(name, of_trace.recording_id, amplitude_program(of_trace), is_control, *amounts, table.cdbs_ma)


@dataclass(frozen=True)
class _Means:
    """Mean and mean square over the known steps; None where too few are known or the value was not requested."""

    mean: float | None
    square: float | None

    def times(self, unit: float) -> _Means:
        """Convert to another unit, by multiplying with the size of `unit`."""
        return _Means(None if self.mean is None else unit * self.mean, None if self.square is None else unit**2 * self.square)


def _means(values: NDArray[np.float64], square: Callable[[ArrayLike], float] | None = None) -> _Means:
    """Average a session's steps, shape [n], NaN where unknown; `square` takes the mean square of the known ones."""
    unknown = np.isnan(values)
    known = values[~unknown] if unknown.any() else values
    if not known.size or known.size < KNOWN_SHARE * values.size:
        return _Means(None, None)
    return _Means(float(known.mean()), square(known) if square else None)


# Facts of sessions as the statistics want them: one metric of a controller (or a policy) and of cDBS. No database.

HIGHER_IS_BETTER = {"energy": False, "mean_beta": False} | {o.key: o.higher_is_better for o in OUTCOMES}
RESOLUTION = {"energy": 0.05} | {o.key: o.resolution for o in OUTCOMES}
"""Step between neighbouring values of a metric; 0 where it is continuous. Stimulators deliver steps of 0.1 mA: at cDBS of 4 mA, 0.05 of its
energy. Without it, a controller of one constant amplitude would save the same at every visit, and no test could report a saving. Nor could
a test report that a participant never trembles, if shares of the time were taken as more exact than 1 %.
"""

BOUNDED = frozenset(o.key for o in OUTCOMES if o.bounded)
"""Metrics that end at a floor or a ceiling which sessions reach."""


@dataclass(frozen=True)
class Chosen:
    """The sessions of a comparison, aligned with its measurements, n of them.

    Attributes:
        data: values of one metric. sessions: the facts, [n]. stopped: stopped for the patient's sake, [n].
        policy: numbers, 0 for none, [n].
    """

    data: Measurements
    sessions: tuple[Facts, ...]
    stopped: NDArray[np.bool_]
    policy: NDArray[np.int64]


def choose(sessions: Sequence[Facts], metric: str, is_tested: Callable[[Facts], bool]) -> Chosen:
    """Choose one metric of the sessions that `is_tested` selects and of all cDBS sessions."""
    return choose_each(sessions, (metric,), is_tested)[metric]


def choose_each(sessions: Sequence[Facts], metrics: Sequence[str], is_tested: Callable[[Facts], bool]) -> dict[str, Chosen]:
    """Choose several metrics of the same sessions."""
    taken = tuple(s for s in sessions if s.controller is Controller.CDBS or is_tested(s))
    nothing = float("nan")
    plain = Measurements.of(
        np.full(len(taken), nothing),
        [s.visit for s in taken],
        [s.controller is not Controller.CDBS for s in taken],
        order=[float(s.ordinal) for s in taken],
        medication_h=[nothing if s.medication_h is None else s.medication_h for s in taken],
    )
    stopped = np.array([s.stopped is not None for s in taken], dtype=np.bool_)
    policy = np.array([s.arm.policy_id or 0 for s in taken], dtype=np.int64)
    found = {}
    for metric in metrics:
        value = np.array([s.values.get(metric, nothing) for s in taken], dtype=np.float64)
        data = replace(plain, value=value, resolution=RESOLUTION.get(metric, 0.0), bounded=metric in BOUNDED)
        found[metric] = Chosen(data, taken, stopped, policy)
    return found


def of_controller(controller: Controller) -> Callable[[Facts], bool]:
    """Select sessions of a controller, whichever policy ran."""
    return lambda s: s.controller is controller


def comparable_beta(sessions: Sequence[Facts], unit: str | None, source: str | None) -> BetaKind | None:
    """Choose the kind of beta that is compared: the participant's where some session has it, else the most frequent."""
    kinds = Counter(s.beta_kind for s in sessions if s.beta_kind and "mean_beta" in s.values)
    wanted = BetaKind(unit or "", source or "")
    if wanted in kinds or not kinds:
        return wanted if kinds else None
    return kinds.most_common(1)[0][0]


def with_comparable_beta(sessions: Sequence[Facts], kind: BetaKind | None) -> tuple[Facts, ...]:
    """Return the sessions; remove the mean beta of those with another kind of beta."""
    return tuple(
        s
        if "mean_beta" not in s.values or s.beta_kind == kind
        else replace(
            s,
            values={k: v for k, v in s.values.items() if k != "mean_beta"},
            missing={**s.missing, "mean_beta": Missing.OTHER_BETA},
        )
        for s in sessions
    )
