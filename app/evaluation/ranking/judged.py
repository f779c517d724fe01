"""Cache of verdicts per evaluation, kept by this process under all that a verdict depends on.

An evaluation and its estimates never change. Verdicts also depend on the margins and levels in force, the present policies, the cDBS
amplitude and what happened under which policy. A page also depends on the sessions so far. All of these are in the key as values or, for
sessions, as their rows' versions, so that every change makes a new key. The draws themselves, a megabyte of JSON, are read only where
something is not cached yet.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM, Caller
from app.evaluation import repository
from app.evaluation.ranking.answer import Answer, Row, answer
from app.evaluation.ranking.assessment import Assessed, Assessment, assess, cdbs_amplitude_now
from app.evaluation.ranking.decisions import findings_of
from app.evaluation.ranking.picture import Picture, picture
from app.evaluation.ranking.results import RandomSessions, random_sessions, tested_before
from app.evaluation.repository import PolicyHead
from app.evaluation.schemas import TestedBefore
from app.platform.errors import Invalid
from app.platform.kept import kept
from app.study import blinding
from app.study import repository as study_repository
from app.study.adverse_events import Events, blocking_events, events_of_participant
from app.study.sessions.repository import ReadOnce
from app.tables.evaluations import Evaluation
from app.tables.learning import BufferSnapshot
from app.tables.participants import Participant, SettingsVersion
from ml.designs import Bound
from ml.ope import Estimate, Flag, method_keys

T = TypeVar("T")

DRAWS = ("draws", "outcome_draws")
"""Details of a cached estimate that are removed."""


@dataclass
class Judged:
    """One evaluation of a participant, by one method, under its present verdicts; of one request.

    Attributes:
        heads: its present policies, by id. happened: by policy, serious events and stops that no clinician has cleared.
        caller, sessions: who requests the results of sessions, and the participant's; both None without that request.
    """

    db: Session
    participant: Participant
    evaluation: Evaluation
    method: str
    heads: Mapping[int, PolicyHead]
    happened: Mapping[int, tuple[Flag, ...]]
    cdbs_ma: float | None
    caller: Caller | None = None
    sessions: ReadOnce | None = None

    @cached_property
    def key(self) -> Hashable:
        """Everything that cached results depend on, besides this code."""
        margins, levels = self.participant.margins_in_force.id, self.participant.current_margins.id
        heads, happened = tuple(self.heads.values()), tuple(self.happened.items())
        judged = (self.evaluation.id, self.evaluation.created_at, self.method, heads, happened, self.cdbs_ma)
        shown: Hashable = None
        if self.caller is not None and self.sessions is not None:
            shown = (self.sessions.fingerprint, blinding.sights(self.db, [self.participant], self.caller)[0])
        return (*judged, margins, levels, shown)

    def kept(self, name: Hashable, compute: Callable[[], T]) -> T:
        """Return a cached result; the name must include its other inputs."""
        return kept((name, self.key), compute)

    @cached_property
    def tested(self) -> dict[int, TestedBefore]:
        """Results of sessions, by policy; empty where they are not requested."""
        if self.caller is None or self.sessions is None:
            return {}
        cdbs = next((i for i, head in self.heads.items() if head.is_cdbs), None)
        return tested_before(self.db, self.evaluation, self.participant, self.caller, cdbs, self.sessions)

    @cached_property
    def with_draws(self) -> Assessment:
        """The assessment with every draw, read and judged again. For computing what is cached."""
        version = study_repository.settings_version(self.db, self.evaluation.settings_version_id)
        found = assess(self.evaluation, self.heads, self.method, self.participant, version, self.cdbs_ma, self.happened)
        return found.with_tests(self.tested)

    @cached_property
    def assessment(self) -> Assessment:
        """The same without the draws of its estimates."""

        def read() -> tuple[tuple[Assessed, ...], bool]:
            return tuple(_without_draws(a) for a in self.with_draws.assessed), self.with_draws.ordered

        assessed, ordered = self.kept("assessed", read)
        return Assessment(self.evaluation, self.participant, self.method, assessed, self.cdbs_ma, ordered)

    @cached_property
    def _answer_with_draws(self) -> Answer:
        return answer(self.with_draws)

    @cached_property
    def answer(self) -> Answer:
        """Candidates to test and not to test; the estimates are without draws."""

        def read() -> Answer:
            found = self._answer_with_draws
            rows, like_cdbs, like_off = (tuple(map(_row_without_draws, of)) for of in (found.rows, found.like_cdbs, found.like_off))
            fixed = replace(found.fixed, row=_row_without_draws(found.fixed.row)) if found.fixed is not None else None
            return replace(found, rows=rows, like_cdbs=like_cdbs, like_off=like_off, fixed=fixed)

        return self.kept("answer", read)

    def random_sessions(self, settings: SettingsVersion) -> RandomSessions | None:
        """Return measured results of random sessions so far; None without any, and where sessions are not requested."""
        if self.caller is None or self.sessions is None:
            return None
        return random_sessions(self.sessions.rows, self.caller, settings, self.participant.margins_in_force, self.cdbs_ma)

    def picture(self, bound: Bound, policy_id: int | None = None) -> Picture:
        """Draw the picture of the candidates, those that act like cDBS last, or of one candidate.

        Args:
            bound: B, fraction of cDBS. policy_id: a candidate, which is drawn under its own name where it is a twin.
        """

        def read() -> Picture:
            found, unit = self._answer_with_draws, self.db.get_one(BufferSnapshot, self.evaluation.snapshot_id).beta_unit
            one = None if policy_id is None else found.everyone().get(policy_id)
            rows = [*found.rows, *found.like_off, *found.like_cdbs] if policy_id is None else [replace(one, twins=())] if one else []
            return picture(self.with_draws, rows, unit, bound)

        return self.kept(("picture", bound, policy_id), read)


def _with_copies(events: Events, heads: Mapping[int, PolicyHead]) -> dict[int, tuple[Flag, ...]]:
    """Return findings by policy, of students and teachers too: a student does what its teacher does."""
    found = dict(events)
    for i, head in heads.items():
        if head.teacher_id is not None:
            found[i] = (*found.get(i, ()), *events.get(head.teacher_id, ()))
            found[head.teacher_id] = (*found.get(head.teacher_id, ()), *events.get(i, ()))
    return {i: findings_of(found[i]) for i in sorted(found) if found[i]}


def judged(
    db: Session,
    participant: Participant,
    evaluation: Evaluation,
    method: str | None = None,
    caller: Caller | None = None,
    sessions: ReadOnce | None = None,
) -> Judged:
    """Judge one evaluation, the newest or not, by the present inputs.

    Args:
        db, participant, evaluation: whose. method: whose estimates rank; the evaluation's default where not given.
        caller, sessions: as `Judged` has them.

    Raises:
        Invalid: it has no estimate by the method.
    """
    chosen = method or evaluation.default_method
    if chosen != evaluation.default_method or chosen not in method_keys():
        stored = repository.methods(db, evaluation.id)
        there = [m for m in method_keys() if m in stored]
        if chosen not in there:
            raise Invalid(f"This ranking has no estimates by '{chosen}'.", f"Choose one of {', '.join(there)}.")
    heads, cdbs_ma = repository.policy_heads(db, evaluation.id), cdbs_amplitude_now(participant)
    # a verdict does not depend on who asks for it
    happened = _with_copies(blocking_events(events_of_participant(db, participant.id), SYSTEM), heads)
    return Judged(db, participant, evaluation, chosen, heads, happened, cdbs_ma, caller, sessions)


class _WithoutDraws(dict[str, Any]):
    """Details of an estimate whose draws were removed: to read them is an error, not an empty answer."""

    def __getitem__(self, name: str) -> Any:
        return super().__getitem__(_present(name))

    def __contains__(self, name: object) -> bool:
        return super().__contains__(_present(name))

    def get(self, name: str, default: Any = None) -> Any:
        return super().get(_present(name), default)


def _present(name: Any) -> Any:
    if name in DRAWS:
        raise RuntimeError(f"the {name} of a cached estimate were removed: use the assessment with draws")
    return name


def _without_draws(one: Assessed) -> Assessed:
    slim = {method: _slim(e) for method, e in one.estimates.items()}
    return replace(one, estimate=_slim(one.estimate) if one.estimate else None, estimates=slim)


def _slim(estimate: Estimate) -> Estimate:
    return replace(estimate, details=_WithoutDraws({k: v for k, v in estimate.details.items() if k not in DRAWS}))


def _row_without_draws(row: Row) -> Row:
    return replace(row, one=_without_draws(row.one), twins=tuple(map(_row_without_draws, row.twins)))
