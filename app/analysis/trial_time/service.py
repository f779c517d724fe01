"""Minutes that each controller was tested in each participant: the table of trial time (Gao et al. 2023, section 6.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.study import repository as study
from app.study.blinding import CONTROLLER_NAMES, visible_arm
from app.study.models import Controller, Participant, StudySession

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
    counted: list[dict[Controller, list[float]]] = []
    excluded: list[int] = []
    by_participant: dict[int, list[StudySession]] = {p.id: [] for p in participants}
    for session in study.sessions_without_data(db, list(by_participant)):
        by_participant[session.visit.participant_id].append(session)
    for participant in participants:
        held = by_participant[participant.id]
        seconds: dict[Controller, list[float]] = {}
        for session in held:
            if session.excluded_reason is None and (known := visible_arm(session, caller)) is not None:
                seconds.setdefault(known.controller, []).append(session.duration_s)
        counted.append(seconds)
        excluded.append(sum(session.excluded_reason is not None for session in held))
    others = [c for c in Controller if c not in PAPER_ORDER and any(c in seconds for seconds in counted)]
    controllers = [*PAPER_ORDER, *others]
    rows = [
        TrialTimeRow(participant.code, [_tested(c, seconds.get(c, [])) for c in controllers], left_out)
        for participant, seconds, left_out in zip(participants, counted, excluded, strict=True)
    ]
    totals = [_tested(c, [s for seconds in counted for s in seconds.get(c, [])]) for c in controllers]
    return TrialTime(controllers, [CONTROLLER_NAMES[c] for c in controllers], rows, totals)


def _tested(controller: Controller, seconds: Sequence[float]) -> TimeTested:
    return TimeTested(controller, len(seconds), sum(seconds) / 60)
