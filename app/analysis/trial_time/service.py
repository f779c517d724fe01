"""Minutes that each controller was tested in each participant: the table of trial time (Gao et al. 2023, section 6.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis.evidence.facts import LeftOut
from app.analysis.evidence.service import Evidence
from app.study import repository as study
from app.study.blinding import CONTROLLER_NAMES, Arm, visible_arms
from app.tables.participants import Participant
from app.tables.sessions import Controller, StudySession

PAPER_ORDER = (Controller.CDBS, Controller.RL, Controller.DISTILLED, Controller.NO_DBS)
"""The paper's columns; controllers that it does not list follow where some session has them."""


@dataclass(frozen=True)
class TimeTested:
    """One controller in one participant: confirmed sessions that are not excluded, and their minutes."""

    controller: Controller
    sessions: int
    minutes: float


@dataclass(frozen=True)
class TrialTimeRow:
    """One participant.

    Attributes:
        tested: one entry for each of the table's controllers, with zeros where it was not tested.
        excluded: sessions that are left out because somebody excluded them.
    """

    participant: str
    tested: list[TimeTested]
    excluded: int


@dataclass(frozen=True)
class TrialTime:
    """The table; `totals` over all its participants."""

    controllers: list[Controller]
    labels: list[str]
    rows: list[TrialTimeRow]
    totals: list[TimeTested]


def trial_time(db: Session, participants: Sequence[Participant], caller: Caller) -> TrialTime:
    """The table over these participants, in their order. Proposed and excluded sessions do not count."""
    by_participant: dict[int, list[StudySession]] = {p.id: [] for p in participants}
    for session in study.sessions_without_data(db, list(by_participant)):
        by_participant[session.visit.participant_id].append(session)
    counted = []
    for participant in participants:
        held = by_participant[participant.id]
        counting = [s for s in held if s.excluded_reason is None]
        ran = [(arm, s.duration_s) for s, arm in zip(counting, visible_arms(counting, caller), strict=True)]
        counted.append(_Counted(participant.code, ran, sum(s.excluded_reason is not None for s in held)))
    return _table(counted)


def of_evidence(held: Sequence[Evidence]) -> TrialTime:
    """The same where the evidence of the participants is at hand."""
    counted = []
    for one in held:
        ran = [(s.arm, s.duration_s) for s in one.sessions] + [(e.arm, e.duration_s) for e in one.excluded]
        counted.append(_Counted(one.participant, ran, sum(e.why is LeftOut.EXCLUDED for e in one.excluded)))
    return _table(counted)


@dataclass(frozen=True)
class _Counted:
    """Sessions of one participant with their seconds, no arm where it is not known to the reader; and how many are excluded."""

    participant: str
    ran: Sequence[tuple[Arm | None, float]]
    excluded: int


def _table(counted: Sequence[_Counted]) -> TrialTime:
    by_controller: list[dict[Controller, list[float]]] = []
    for one in counted:
        seconds: dict[Controller, list[float]] = {}
        for arm, duration_s in one.ran:
            if arm is not None:
                seconds.setdefault(arm.controller, []).append(duration_s)
        by_controller.append(seconds)
    others = [c for c in Controller if c not in PAPER_ORDER and any(c in seconds for seconds in by_controller)]
    controllers = [*PAPER_ORDER, *others]
    rows = [
        TrialTimeRow(one.participant, [_tested(c, seconds.get(c, [])) for c in controllers], one.excluded)
        for one, seconds in zip(counted, by_controller, strict=True)
    ]
    totals = [_tested(c, [s for seconds in by_controller for s in seconds.get(c, [])]) for c in controllers]
    return TrialTime(controllers, [CONTROLLER_NAMES[c] for c in controllers], rows, totals)


def _tested(controller: Controller, seconds: Sequence[float]) -> TimeTested:
    return TimeTested(controller, len(seconds), sum(seconds) / 60)
