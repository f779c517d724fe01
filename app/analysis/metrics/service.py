"""Five metrics of every controller against cDBS, as in the paper's results. Source: Gao et al. 2023, section 6.1."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis.metrics.comparisons import Comparison, Group, adjust, compare, group
from app.platform.errors import Invalid
from app.study import repository as study
from app.study.blinding import CONTROLLER_NAMES, arm
from app.study.models import Controller, Participant, SettingsVersion, StudySession
from app.study.sessions.data import qoc_of, session_data
from app.study.sessions.stimulation import MEAN_FRACTION, fits
from ml.energy import relative_energy, saving_percent

KNOWN_SHARE = 0.5
"""Share of a session's steps that must be known for its energy and its mean beta to stand for the session (ours)."""

TITLES: dict[str, tuple[str, str]] = {
    "energy": ("Stimulation energy", "cDBS = 1"),
    "mean_beta": ("Mean beta amplitude", ""),
    "grasp": ("Grasp frequency", "Hz"),
    "rating": ("Rating", "1\u201310"),
    "tremor": ("Tremor", "% of session"),
}
"""The paper's five metrics: title and unit; the unit of beta is the participant's."""

LIMITS = (
    "Sessions of one visit are not independent: they share the day, the medication and what the session before left. The test treats "
    "them as independent, so that its p-values may be too small.",
    "A p of .05 or more does not show that two controllers do equally well; the difference and its interval say what the data leave open.",
    "Energy is the mean squared amplitude fraction of the session's steps, at the pulse width and rate of cDBS. Every session counts once, "
    "whatever its length, and all policies of one kind are taken together.",
)


@dataclass(frozen=True)
class BetaKind:
    """What makes beta amplitudes comparable."""

    unit: str
    source: str


@dataclass(frozen=True)
class SessionMetrics:
    """What one session contributes; a metric that was not measured is absent."""

    session: StudySession
    controller: Controller
    values: Mapping[str, float]
    beta_kind: BetaKind | None
    mean_fraction: float | None


@dataclass(frozen=True)
class AmplitudeMismatch:
    """A session whose mean amplitude fraction is not that of its controller; it counts all the same until somebody corrects it."""

    session_id: int
    visit: int
    ordinal: int
    controller: Controller
    mean_fraction: float
    text: str


@dataclass(frozen=True)
class Excluded:
    """A session that the analysis leaves out altogether."""

    session_id: int
    visit: int
    ordinal: int
    reason: str


@dataclass(frozen=True)
class ControllerSummary:
    """One controller's share of the study (the paper's table of trial time), and what it saves.

    Attributes:
        energy_saving_percent: against the mean energy of the cDBS sessions; None without both, and for cDBS itself.
    """

    controller: Controller
    label: str
    sessions: int
    minutes: float
    energy_saving_percent: float | None


@dataclass(frozen=True)
class MetricResult:
    """One metric by controller, each compared with cDBS.

    Attributes:
        notes: sessions that this metric leaves out, and why.
    """

    metric: str
    title: str
    unit: str
    groups: list[Group]
    comparisons: list[Comparison]
    notes: list[str]

    @property
    def n(self) -> int:
        """Sessions with a value."""
        return sum(g.n for g in self.groups)


@dataclass(frozen=True)
class FiveMetrics:
    """The analysis of one participant."""

    participant: str
    sessions: int
    controllers: list[ControllerSummary]
    metrics: list[MetricResult]
    excluded: list[Excluded]
    warnings: list[AmplitudeMismatch]
    limits: list[str]


def five_metrics(db: Session, participant: Participant, caller: Caller) -> FiveMetrics:
    """Energy, mean beta, grasp, rating and tremor of every session, by controller, each controller compared with cDBS."""
    included: list[SessionMetrics] = []
    excluded: list[Excluded] = []
    for session in study.sessions_of_participant(db, participant.id, with_proposals=True):
        reason = session.excluded_reason or ("not confirmed yet" if session.status == "proposed" else "")
        if not reason:
            try:
                included.append(session_metrics(db, session, caller))
                continue
            except Invalid as error:
                reason = f"cannot be read: {error.detail}"
        excluded.append(Excluded(session.id, session.visit.number, session.ordinal, reason))
    present = [c for c in Controller if any(s.controller is c for s in included)]
    metrics = _adjusted([_metric(name, included, present, participant.current_settings) for name in TITLES])
    tests = sum(c.p_value is not None for m in metrics for c in m.comparisons)
    holm = f"p-values are unadjusted, as in the paper; Holm's adjustment beside them covers all {tests} comparisons of this page."
    controllers = [_summary(c, [s for s in included if s.controller is c], metrics[0]) for c in present]
    return FiveMetrics(participant.code, len(included), controllers, metrics, excluded, _mismatches(included), [*LIMITS, holm])


def session_metrics(db: Session, session: StudySession, caller: Caller) -> SessionMetrics:
    """The five metrics of one session.

    Raises:
        Invalid: traces that do not fit the session's grid.
    """
    table = session_data(db, session).table
    during, qoc = table.t_s > 0, qoc_of(session)
    fraction, beta = table.fraction[during], table.beta[during]
    found = {
        "energy": relative_energy(fraction) if _known(fraction) else None,
        "mean_beta": float(np.nanmean(beta)) if _known(beta) else None,
        "grasp": qoc.grasp_hz,
        "rating": qoc.rating,
        "tremor": qoc.tremor_percent,
    }
    kind = BetaKind(table.beta_trace.unit, table.beta_trace.source) if table.beta_trace else None
    values = {name: float(value) for name, value in found.items() if value is not None and math.isfinite(value)}
    return SessionMetrics(session, arm(session, caller).controller, values, kind, float(np.nanmean(fraction)) if _known(fraction) else None)


def _mismatches(sessions: Sequence[SessionMetrics]) -> list[AmplitudeMismatch]:
    """Sessions that were stimulated otherwise than their controller says."""
    found = []
    for s in sessions:
        mean = s.mean_fraction
        if mean is None or fits(s.controller, mean):
            continue
        visit, ordinal = s.session.visit.number, s.session.ordinal
        low, high = MEAN_FRACTION[s.controller]
        asked = f"{low:g} to {high:g}" if low > 0 else f"at most {high:g}"
        text = (
            f"Session {s.session.id} (visit {visit}, place {ordinal}) is a {CONTROLLER_NAMES[s.controller]} session, but its mean "
            f"amplitude fraction is {mean:.2f}; {asked} is expected. It counts until its controller or the cDBS amplitude is corrected."
        )
        found.append(AmplitudeMismatch(s.session.id, visit, ordinal, s.controller, mean, text))
    return found


def _known(values: NDArray[np.float64]) -> bool:
    return bool(values.size) and float(np.mean(~np.isnan(values))) >= KNOWN_SHARE


def _metric(name: str, sessions: Sequence[SessionMetrics], present: Sequence[Controller], settings: SettingsVersion) -> MetricResult:
    title, unit = TITLES[name]
    used, notes = [s for s in sessions if name in s.values], []
    if len(used) < len(sessions):
        notes.append(f"{_sessions(len(sessions) - len(used))} without this metric.")
    if name == "mean_beta" and (kind := _beta_kind(used, settings)):
        comparable = [s for s in used if s.beta_kind == kind]
        notes += _beta_notes(used, comparable, kind)
        used, unit = comparable, kind.unit
    groups = [group(c, {s.session.id: s.values[name] for s in used if s.controller is c}) for c in present]
    cdbs = next((g for g in groups if g.controller is Controller.CDBS), group(Controller.CDBS, {}))
    comparisons = [compare(g, cdbs) for g in groups if g.controller is not Controller.CDBS]
    return MetricResult(name, title, unit, groups, comparisons, notes)


def _beta_kind(sessions: Sequence[SessionMetrics], settings: SettingsVersion) -> BetaKind | None:
    """The participant's unit and source where some session has them, else the most frequent."""
    kinds = Counter(s.beta_kind for s in sessions if s.beta_kind)
    wanted = BetaKind(settings.beta_unit or "", settings.beta_source or "")
    if wanted in kinds or not kinds:
        return wanted if kinds else None
    return kinds.most_common(1)[0][0]


def _beta_notes(used: Sequence[SessionMetrics], comparable: Sequence[SessionMetrics], kind: BetaKind) -> list[str]:
    notes = []
    if len(comparable) < len(used):
        others = sorted({f"{s.beta_kind.unit} ({s.beta_kind.source})" for s in used if s.beta_kind and s.beta_kind != kind})
        left_out = _sessions(len(used) - len(comparable))
        notes.append(f"{left_out} in {', '.join(others)} left out: only beta in {kind.unit} ({kind.source}) is compared.")
    if len({s.session.hemisphere for s in comparable if s.session.hemisphere}) > 1:
        notes.append("Both hemispheres are taken together.")
    return notes


def _adjusted(metrics: Sequence[MetricResult]) -> list[MetricResult]:
    adjusted = iter(adjust([c for m in metrics for c in m.comparisons]))
    return [replace(m, comparisons=[next(adjusted) for _ in m.comparisons]) for m in metrics]


def _summary(controller: Controller, sessions: Sequence[SessionMetrics], energy: MetricResult) -> ControllerSummary:
    means = {g.controller: float(np.mean(g.values)) for g in energy.groups if g.n}
    saving, reference = None, means.get(Controller.CDBS, 0.0)
    if controller is not Controller.CDBS and controller in means and reference > 0:
        saving = saving_percent(means[controller], reference)
    seconds = sum(s.session.duration_s for s in sessions)
    return ControllerSummary(controller, CONTROLLER_NAMES[controller], len(sessions), seconds / 60, saving)


def _sessions(count: int) -> str:
    return "1 session" if count == 1 else f"{count} sessions"
