"""Amplitudes that policies would have requested on a recorded session's beta. No forecast: under them beta would have differed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.evaluation.ranking.answer import Answer
from app.evaluation.ranking.service import current
from app.learning import foreign
from app.learning.policies import onnx_of
from app.platform import files
from app.platform.errors import Invalid, NotFound
from app.platform.kept import kept
from app.platform.numbers import ma
from app.platform.web.schemas import Model
from app.study import access
from app.study import repository as study_repository
from app.study.blinding import require_known
from app.study.sessions.usable_steps import SessionData, session_data
from app.study.traces import StepTable
from app.tables.learning import BufferSnapshot, Policy
from app.tables.participants import Participant
from app.tables.recordings import Trace
from app.tables.sessions import StudySession
from ml.energy import relative_energy
from ml.ope import NEARLY_OFF, SAME_AMPLITUDE
from ml.policies.onnx_policy import PolicyFileError

# API types of the comparison of policies on a recorded session.


class AskedOut(Model):
    """Amplitudes that one policy would have requested."""

    policy_id: int
    name: str
    fraction: list[float | None] = Field(
        description="Of the cDBS amplitude, per step; null where no whole window of beta had come, and cDBS would have been on."
    )
    mean_fraction: float | None = Field(description="Over the steps with an answer.")
    energy: float | None = Field(description="Mean squared fraction; cDBS is 1.")
    nearly_off: float | None = Field(description="Share of the steps below 0.2 of the cDBS amplitude.")


class DifferenceOut(Model):
    """Distance of two policies, over the steps that both answer."""

    policy_id: int
    other_id: int
    mean_fraction: float = Field(description="Of the first less the second.")
    apart: float = Field(description="Share of the steps in which they are more than 0.05 of the cDBS amplitude apart.")
    most_at_s: float = Field(description="Begin of the step in which they are furthest apart, seconds of the session.")
    most: float = Field(description="Of the first less the second in that step.")


class ReplayOut(Model):
    """Policies over a recorded session's beta: what they would have asked, not what would have happened."""

    participant: str
    session_id: int
    visit: int
    period_s: float
    beta_unit: str
    cdbs_amplitude_ma: float | None
    t_s: list[float] = Field(description="Begin of each step, seconds of the session.")
    beta: list[float | None] = Field(description="Over the step before, as known when the amplitude was asked for.")
    recorded_fraction: list[float | None] = Field(description="What stimulated in fact.")
    asked: list[AskedOut]
    differences: list[DifferenceOut]


# Which policies a comparison begins with: the best of the ranking, each behaviour once.

TWO = 2
"""Policies that a comparison begins with: they already show a difference, and a third is one choice away."""


def best_first(db: Session, participant: Participant, policies: Sequence[Policy], caller: Caller) -> list[Policy]:
    """Sort policies by the ranking, as `ordered` does; as given where there is no ranking."""
    try:
        return ordered(policies, current(db, participant, caller).answer)
    except NotFound:
        return list(policies)


def ordered(policies: Sequence[Policy], answered: Answer) -> list[Policy]:
    """Sort policies: those that may be planned, what to test first; then those like cDBS, and those not advised; each behaviour once before
    any twice.

    Policies that are not in the ranking come last, as given.
    """
    distinct = (*answered.rows, *answered.like_cdbs, *answered.like_off)
    heads = [r.one.policy.id for r in sorted(distinct, key=lambda r: r.decided.needs_override)]
    places = {i: k for k, i in enumerate(dict.fromkeys((*heads, *answered.everyone())))}
    return sorted(policies, key=lambda p: places.get(p.id, len(places)))


def other_than(policy: Policy, policies: Sequence[Policy], answered: Answer | None) -> Policy | None:
    """Choose the best of some policies to compare one with: of another behaviour where there is one; None where there is no other."""
    heads = answered.heads() if answered is not None else {}
    others = [p for p in (ordered(policies, answered) if answered is not None else policies) if p.id != policy.id]
    unlike = (p for p in others if heads.get(p.id, p.id) != heads.get(policy.id, policy.id))
    return next(unlike, others[0] if others else None)


# Runs two or three policies over a recorded session and says how they differ.

ASK = "app.evaluation.policies.replay_compute:ask"
MOST = 3
"""Policies at once: more lines hide each other."""

MOST_TRIED = 20
"""Sessions whose beta is read to find one that fits; with more the page would take seconds where none does."""

MOST_STEPS = 5000
"""Steps of a session that are run: at 2 s nearly three hours."""
Floats = NDArray[np.float64]


def sessions_to_replay(db: Session, participant: Participant) -> Sequence[StudySession]:
    """List sessions over whose beta policies may be run, newest first; none of a blinded plan whose key is sealed."""
    found = study_repository.sessions_of_participant(db, participant.id)
    return [s for s in reversed(found) if s.excluded_reason is None and not s.visit.sealed]


def replay(db: Session, participant: Participant, session_id: int, policies: Sequence[Policy], caller: Caller) -> ReplayOut:
    """Compute what policies would have requested before every step of a session.

    Args:
        db: the session. participant: whose session and policies. session_id: of the recorded session. policies: one to three.
        caller: must be allowed to know what ran.

    Raises:
        NotFound: no such session. Forbidden: what ran is hidden from the caller. Invalid: none or too many policies, or a file that cannot
            be run. Also a session without beta or too long, or beta of another unit or source than a policy learned from.
    """
    return replay_over(db, participant, recorded(db, participant, session_id, caller), policies)


def recorded(db: Session, participant: Participant, session_id: int, caller: Caller) -> SessionData:
    """Load a session over which policies may be run. Raises NotFound and Forbidden as `replay` does."""
    session = study_repository.session(db, session_id, caller)
    access.require_own(participant, session.visit, f"session {session_id}")
    require_known(session.visit, caller)
    return session_data(db, session)


def fitting(db: Session, participant: Participant, data: SessionData, policies: Sequence[Policy]) -> list[Policy]:
    """Filter policies: those that take beta as the session has it, in the same order; all of them where it has none."""
    trace = data.table.beta_trace
    return [p for p in policies if trace is None or _signal(db, participant, p) == (trace.unit, trace.source)]


def newest_fitting(
    db: Session, participant: Participant, sessions: Sequence[StudySession], policies: Sequence[Policy], caller: Caller, *, every: bool
) -> SessionData | None:
    """Find the first of some sessions, newest first, whose beta policies take; None where none of the first MOST_TRIED has it.

    Args:
        db, participant, caller: as in `replay`. sessions: as `sessions_to_replay` gives them. policies: at least one.
        every: whether all the policies must take it, or one is enough.

    Raises:
        Forbidden: as `replay`.
    """
    taken = [_signal(db, participant, p) for p in policies]
    for session in sessions[:MOST_TRIED]:
        try:
            data = recorded(db, participant, session.id, caller)
        except Invalid:
            continue  # the page of such a session says why its steps cannot be read
        trace = data.table.beta_trace
        if trace is None or not np.isfinite(data.table.beta).any():
            continue
        fits = [signal == (trace.unit, trace.source) for signal in taken]
        if all(fits) if every else any(fits):
            return data
    return None


def replay_over(db: Session, participant: Participant, data: SessionData, policies: Sequence[Policy]) -> ReplayOut:
    """Compute the replay over a session that `recorded` gave. Raises Invalid as `replay` does."""
    if not 1 <= len(policies) <= MOST:
        raise Invalid(f"{len(policies)} policies cannot be compared.", f"Choose one to {MOST}.")
    session, session_id = data.session, data.session.id
    table, window, period = data.table, data.settings.window, data.settings.period_s
    trace = table.beta_trace
    if trace is None or not np.isfinite(table.beta).any():
        raise Invalid(f"Session {session_id} has no beta to run a policy over.", "Choose another session.")
    steps = int((table.t_s > 0).sum())
    if not 1 <= steps <= MOST_STEPS:
        raise Invalid(f"Session {session_id} has {steps} steps; one to {MOST_STEPS} can be run.", "Choose another session.")
    for policy in policies:
        _require_signal(db, participant, policy, trace)
    rows = _rows(table, window)
    asked = _asked(policies, rows, window, period)
    recorded = table.fraction[table.t_s > 0]
    begins = table.t_s[table.t_s > 0] - period
    return ReplayOut(
        participant=participant.code,
        session_id=session.id,
        visit=session.visit.number,
        period_s=period,
        beta_unit=trace.unit,
        cdbs_amplitude_ma=table.cdbs_ma,
        t_s=[float(t) for t in begins],
        beta=_list(rows[window - 1 : -1]),
        recorded_fraction=_list(recorded),
        asked=[_summary(p, asked[p.id]) for p in policies],
        differences=[d for a, b in combinations(policies, 2) if (d := _difference(a, b, asked, begins)) is not None],
    )


def _rows(table: StepTable, window: int) -> Floats:
    """Return beta of the W rows before the session and of the session, [W + T]."""
    during = table.beta[table.t_s > 0]
    lead = table.beta[table.t_s <= 0][-window:]
    return np.concatenate([np.full(window - lead.size, np.nan), lead, during])


def _asked(policies: Sequence[Policy], rows: Floats, window: int, period_s: float) -> Mapping[int, Floats]:
    key = ("replay", tuple((p.id, p.onnx_sha256) for p in policies), window, period_s, rows.tobytes())
    return kept(key, lambda: _run(policies, rows, window, period_s))


def _run(policies: Sequence[Policy], rows: Floats, window: int, period_s: float) -> dict[int, Floats]:
    with files.draft_folder() as folder:
        listed: list[dict[str, Any]] = []
        for policy in policies:
            file = folder / f"{policy.id}.onnx"
            file.write_bytes(onnx_of(policy))
            listed.append({"id": policy.id, "file": str(file)})
        try:
            found = foreign.run(ASK, {"policies": listed, "window": window, "period_s": period_s, "beta": _list(rows)})
        except PolicyFileError as error:
            raise Invalid(f"These policies cannot be run: {error}.", "Leave out those that were made elsewhere.") from error
    for policy in policies:
        if str(policy.id) in found["refused"]:
            raise Invalid(f"Policy '{policy.name}' cannot be run: {found['refused'][str(policy.id)]}.", "Leave it out.")
    return {int(i): np.array([np.nan if v is None else v for v in values]) for i, values in found["asked"].items()}


def _signal(db: Session, participant: Participant, policy: Policy) -> tuple[str | None, str | None]:
    """Return unit and source of the beta that a policy takes; the participant's own for one that was made elsewhere."""
    snapshot = db.get(BufferSnapshot, policy.snapshot_id) if policy.snapshot_id is not None else None
    settings = participant.current_settings
    return (snapshot.beta_unit, snapshot.beta_source) if snapshot else (settings.beta_unit, settings.beta_source)


def _require_signal(db: Session, participant: Participant, policy: Policy, trace: Trace) -> None:
    unit, source = _signal(db, participant, policy)
    if (unit, source) != (trace.unit, trace.source):
        raise Invalid(
            f"Policy '{policy.name}' takes beta in {unit or 'no stated unit'} from {source or 'no stated source'}; the session's is in "
            f"{trace.unit} from {trace.source}.",
            "Choose a session with that beta, or state unit and source in the participant's settings.",
        )


def _summary(policy: Policy, asked: Floats) -> AskedOut:
    known = asked[np.isfinite(asked)]
    return AskedOut(
        policy_id=policy.id,
        name=policy.name,
        fraction=_list(asked),
        mean_fraction=float(known.mean()) if known.size else None,
        energy=relative_energy(known) if known.size else None,
        nearly_off=float(np.mean(known < NEARLY_OFF)) if known.size else None,
    )


def _difference(one: Policy, other: Policy, asked: Mapping[int, Floats], begins: Floats) -> DifferenceOut | None:
    """Compute the distance of two policies; None where no step has an answer of both."""
    apart = asked[one.id] - asked[other.id]
    known = np.isfinite(apart)
    if not known.any():
        return None
    at = int(np.argmax(np.where(known, np.abs(apart), -1.0)))
    return DifferenceOut(
        policy_id=one.id,
        other_id=other.id,
        mean_fraction=float(apart[known].mean()),
        apart=float(np.mean(np.abs(apart[known]) > SAME_AMPLITUDE)),
        most_at_s=float(begins[at]),
        most=float(apart[at]),
    )


def _list(values: Floats) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


# Sentences of the comparison, made at the last moment.

ALIKE = 0.005
"""Policies closer than this on average, fraction of cDBS, ask for the same on average: less than the device resolves."""


def amplitude(found: ReplayOut, fraction: float | None) -> str:
    """Write an amplitude in mA; as a share of cDBS where that is not known in mA."""
    if fraction is None:
        return "—"
    cdbs = found.cdbs_amplitude_ma
    return f"{ma(fraction * cdbs)} mA" if cdbs is not None else f"{100 * fraction:.0f} % of cDBS"


def differences(found: ReplayOut) -> list[str]:
    """Describe how the policies differ, a sentence for each pair."""
    names = {a.policy_id: a.name for a in found.asked}
    return [_difference_words(found, d, names[d.policy_id], names[d.other_id]) for d in found.differences]


def _difference_words(found: ReplayOut, d: DifferenceOut, one: str, other: str) -> str:
    if d.apart == 0:
        return f"{one} and {other} would have asked for the same throughout, within 5 % of the cDBS amplitude."
    mean = amplitude(found, abs(d.mean_fraction))
    if abs(d.mean_fraction) < ALIKE:
        average = f"{one} and {other} would have asked for the same on average"
    else:
        average = f"{one} would have asked for {mean} {'more' if d.mean_fraction > 0 else 'less'} than {other} on average"
    minutes, seconds = divmod(round(d.most_at_s), 60)
    most = f"{amplitude(found, abs(d.most))} {'more' if d.most > 0 else 'less'}"
    often = f"{100 * d.apart:.0f} % of the steps"
    return f"{average}; they are apart in {often}, most at {minutes} min {seconds:02d} s, where {one} asks for {most}."
