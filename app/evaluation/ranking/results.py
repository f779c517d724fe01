"""Sessions that policies drove, read as a snapshot's settings read them, and what they returned; what random sessions have been so far."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.evaluation.ranking.assessment import QUANTITIES, Actual, actual, mean_of
from app.evaluation.schemas import TestedBefore, VisitDifferences
from app.learning.trajectories import trajectory_of
from app.platform.errors import Invalid
from app.platform.kept import kept
from app.study import blinding
from app.study import repository as study_repository
from app.study.blinding import Arm
from app.study.margins import margins_of
from app.study.sessions.repository import ReadOnce
from app.study.sessions.usable_steps import failed_qoc_of
from app.study.settings import mdp_settings
from app.study.traces import TracesOf, laid_out, traces_of
from app.tables.evaluations import Evaluation
from app.tables.learning import BufferSnapshot
from app.tables.participants import MarginsVersion, Participant, SettingsVersion
from app.tables.sessions import Controller, StudySession
from ml.designs import HOLD_SECONDS, LOW_AMPLITUDE, LOW_SECONDS
from ml.mdp import MdpSettings
from ml.outcomes import BY_FIELD, OUTCOMES
from ml.outcomes.records import Outcome
from ml.qoc import Margins, Qoc
from ml.trajectories import SessionTrajectory


@dataclass(frozen=True)
class DrivenSession:
    """One session of a policy (or of cDBS) that may be compared with estimates, or why it may not.

    Attributes:
        session_id, visit: its number, and that of its visit.
        controller, policy_id: what drove it; no policy for cDBS.
        trajectory: its steps; None with `left_out`, the reason. stopped: for the participant's sake.
    """

    session_id: int
    visit: int
    controller: Controller
    policy_id: int | None
    trajectory: SessionTrajectory | None
    left_out: str | None
    stopped: bool = False


def driven_sessions(db: Session, snapshot: BufferSnapshot, caller: Caller, sessions: ReadOnce | None = None) -> list[DrivenSession]:
    """Load every confirmed session of a policy or of cDBS, by visit and order, under a snapshot's settings, unit and source of beta.

    Those of a blinded plan whose key is sealed are excluded, also from what jobs compute for people. The buffer's gate does not matter
    here: it guards what is learnt from, and these sessions are only looked at.

    Args:
        db: the session. snapshot: what the estimates rest on. caller: decides which arms may be known.
        sessions: of the participant, where other code reads them too.
    """
    sessions = sessions or ReadOnce(db, snapshot.participant_id)
    version = study_repository.settings_version(db, snapshot.settings_version_id)
    arms = [(s, blinding.arm(s, caller)) for s in blinding.unsealed(sessions.rows)]
    driven = [(s, arm) for s, arm in arms if arm.policy_id is not None or arm.controller is Controller.CDBS]
    traces, failed = traces_of(db, [s for s, _ in driven]), failed_qoc_of(sessions.rows)
    found = []
    for session, arm in driven:
        read = _read(session, traces, arm, version, snapshot, failed)
        trajectory, reason = (None, read) if isinstance(read, str) else (read, None)
        found.append(
            DrivenSession(
                session.id, session.visit.number, arm.controller, arm.policy_id, trajectory, reason, session.stopped_reason is not None
            )
        )
    return found


def results_by_policy(ran: list[DrivenSession], settings: MdpSettings, horizon_steps: int, cdbs: int | None) -> dict[int, TestedBefore]:
    """Collect actual results by policy, under the estimates' settings, horizon and discount; those of cDBS under its reference's id."""
    results: dict[int, list[Actual]] = defaultdict(list)
    by_visit: dict[int | None, dict[int, list[Actual]]] = defaultdict(lambda: defaultdict(list))
    stopped: Counter[int] = Counter()
    for session in ran:
        policy_id = session.policy_id if session.policy_id is not None else cdbs
        if session.trajectory is None:
            continue
        found_in = actual(session.trajectory, settings, horizon_steps)
        by_visit[session.policy_id][session.visit].append(found_in)
        if policy_id is not None:
            results[policy_id].append(found_in)
            stopped[policy_id] += session.stopped
    visits = {i: _apart(by_visit[i], by_visit[None]) for i in results if i != cdbs}
    apart = {i: {name: mean_of([v[name] for v in found.values()]) for name in QUANTITIES} for i, found in visits.items()}
    return {
        policy_id: TestedBefore(
            sessions=len(found),
            sessions_with_return=sum(a.value is not None for a in found),
            mean_return=mean_of([a.value for a in found]),
            mean_step_return=mean_of([a.step_return for a in found]),
            mean_end_reward=mean_of([a.end_reward for a in found]),
            energy=mean_of([a.energy for a in found]),
            mean_beta=mean_of([a.shown.get("mean_beta") for a in found]),
            stopped=stopped[policy_id],
            energy_difference=apart.get(policy_id, {}).get("energy"),
            mean_beta_difference=apart.get(policy_id, {}).get("mean_beta"),
            **{o.field: mean_of([a.shown.get(o.field) for a in found]) for o in OUTCOMES},
            **{f"{o.field}_difference": apart.get(policy_id, {}).get(o.field) for o in OUTCOMES},
            visits=[
                VisitDifferences(visit=number, **{f"{name}_difference": value for name, value in found.items()})
                for number, found in visits.get(policy_id, {}).items()
            ],
        )
        for policy_id, found in results.items()
    }


def _apart(ours: Mapping[int, Sequence[Actual]], cdbs: Mapping[int, Sequence[Actual]]) -> dict[int, dict[str, float | None]]:
    """Return by visit and quantity a policy's mean less that of the same visit's cDBS; energy as a share of the latter."""
    found: dict[int, dict[str, float | None]] = {}
    for visit in sorted(ours.keys() & cdbs.keys()):
        found[visit] = dict.fromkeys(QUANTITIES)
        for name in QUANTITIES:
            own, other = (mean_of([a.shown.get(name) for a in arm[visit]]) for arm in (ours, cdbs))
            if own is not None and other is not None and (name != "energy" or other > 0):
                found[visit][name] = (own - other) / (other if name == "energy" else 1.0)
    return found


def tested_before(
    db: Session, evaluation: Evaluation, participant: Participant, caller: Caller, cdbs: int | None, sessions: ReadOnce | None
) -> dict[int, TestedBefore]:
    """Return the results by policy of all sessions so far, cached by this process until a row of the participant's sessions changes.

    Args:
        db: the session. evaluation: whose settings, horizon and discount count. participant: whose.
        caller: decides which arms may be known. cdbs: id of the cDBS reference.
        sessions: of the participant, where other code reads them too.
    """
    sessions = sessions or ReadOnce(db, participant.id)
    key = ("tested before", evaluation.id, evaluation.created_at, sessions.fingerprint, cdbs, *blinding.sights(db, [participant], caller))

    def read() -> dict[int, TestedBefore]:
        settings = mdp_settings(study_repository.settings_version(db, evaluation.settings_version_id))
        ran = driven_sessions(db, db.get_one(BufferSnapshot, evaluation.snapshot_id), caller, sessions)
        return results_by_policy(ran, settings, evaluation.horizon_steps, cdbs)

    return kept(key, read)


def _read(
    session: StudySession, traces: TracesOf, arm: Arm, version: SettingsVersion, snapshot: BufferSnapshot, failed: Qoc
) -> SessionTrajectory | str:
    """Read the session's steps, or the reason why they cannot be compared with estimates."""
    try:
        table = laid_out(session, version, traces)
    except Invalid as error:
        return str(error)
    read, trace = trajectory_of(session, table, arm, version, failed), table.beta_trace
    if not isinstance(read, str) and trace is not None and (trace.unit, trace.source) != (snapshot.beta_unit, snapshot.beta_source):
        return f"its beta is in {trace.unit} from {trace.source}, the estimates are in {snapshot.beta_unit} from {snapshot.beta_source}"
    return read


@dataclass(frozen=True)
class RandomSessions:
    """Random sessions that count and that the reader may know of.

    Attributes:
        sessions, visits: how many, at how many visits. minutes: median length.
        lowest, highest: B and the amplitude of cDBS, in `unit`.
        low: only the last `low_minutes` of a session may be below it; None where no amplitude is that low, or the design has no such rule.
        hold_s: shortest and longest time for which an amplitude lasts, s.
        differences: random less cDBS of the same visit, averaged over visits with both, by outcome. worst: of a single session, by outcome.
        beyond: outcomes that were worse than under cDBS by more than the margin, on average.
    """

    sessions: int
    visits: int
    minutes: float
    lowest: float
    low: float | None
    highest: float
    unit: str
    hold_s: tuple[float, float]
    low_minutes: float
    differences: Mapping[str, float]
    worst: Mapping[str, float]
    beyond: tuple[str, ...]


def random_sessions(
    rows: Sequence[StudySession], caller: Caller, settings: SettingsVersion, margins: MarginsVersion, cdbs_ma: float | None
) -> RandomSessions | None:
    """Summarise the random sessions so far; None without any.

    Args:
        rows: confirmed sessions. caller: decides which arms may be known. settings: design, B and period of the next one.
        margins: the participant's. cdbs_ma: where it is known, mA.
    """
    by_visit: defaultdict[int, dict[Controller, list[StudySession]]] = defaultdict(lambda: defaultdict(list))
    for s in blinding.unsealed(rows):
        arm = blinding.visible_arm(s, caller)
        if arm is not None and s.excluded_reason is None:
            by_visit[s.visit_id][arm.controller].append(s)
    drawn = [s for arms in by_visit.values() for s in arms[Controller.RANDOM]]
    if not drawn:
        return None
    factor, unit = (100.0, "% of cDBS") if cdbs_ma is None else (cdbs_ma, "mA")
    held = settings.design != "paper"  # the paper's draws change every step and know no rule for low amplitudes
    differences, worst, usual, allowed = {}, {}, {}, margins_of(margins)
    for outcome in OUTCOMES:
        name = outcome.field
        pairs = [(_values(arms[Controller.RANDOM], name), _values(arms[Controller.CDBS], name)) for arms in by_visit.values()]
        both = [(fmean(ours), fmean(theirs)) for ours, theirs in pairs if ours and theirs]
        if both:
            differences[name], usual[name] = fmean(ours - theirs for ours, theirs in both), fmean(theirs for _, theirs in both)
        if values := _values(drawn, name):
            worst[name] = outcome.worst(values)
    return RandomSessions(
        sessions=len(drawn),
        visits=len({s.visit_id for s in drawn}),
        minutes=median(s.duration_s for s in drawn) / 60,
        lowest=factor * settings.bound,
        low=factor * LOW_AMPLITUDE if held and settings.bound < LOW_AMPLITUDE else None,
        highest=factor,
        unit=unit,
        hold_s=HOLD_SECONDS if held else (settings.period_s, settings.period_s),
        low_minutes=LOW_SECONDS / 60,
        differences=differences,
        worst=worst,
        beyond=tuple(name for name, apart in differences.items() if _is_beyond(BY_FIELD[name], apart, allowed, usual[name])),
    )


def _is_beyond(outcome: Outcome, difference: float, margins: Margins, under_cdbs: float) -> bool:
    """Check whether an outcome is worse by more than its margin."""
    return bool(outcome.loss(difference) > outcome.margin.amount(margins.of(outcome), under_cdbs))


def _values(sessions: Sequence[StudySession], name: str) -> list[float]:
    known = [getattr(s.qoc, name) for s in sessions if s.qoc is not None]
    return [float(v) for v in known if v is not None]
