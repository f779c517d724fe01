"""The trial loop of one synthetic participant: collect, learn, evaluate, plan, test. Each part looks first what is there already."""

from __future__ import annotations

import datetime as dt
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.evaluation.ranking.service import current
from app.pipeline import next_generation
from app.pipeline.next_generation import tested_policies
from app.pipeline.params import NEXT_GENERATION, NextGenerationParams
from app.pipeline.service import start_job
from app.planning.plans import repository as plans
from app.planning.plans import service as planning
from app.planning.plans import view as plan_view
from app.planning.plans.schemas import OverrideIn, PlanIn
from app.planning.plans.view import PlanLine
from app.planning.protocol.schedule import total_minutes
from app.planning.slots import service as slots
from app.platform.database import set_actor, transaction
from app.platform.errors import BetaloopError, Conflict, NotFound
from app.platform.jobs import repository as jobs
from app.platform.jobs.watch import POLL_S, look
from app.simulation.demo.study import participant_body
from app.simulation.design import BETWEEN_VISITS, MORNING, Design, Remembered
from app.simulation.sessions import VisitDay
from app.study import participation as enrolment
from app.study import repository as study_repository
from app.study import visits
from app.study.blinding import CONTROLLER_NAMES
from app.study.participation import ParticipantIn
from app.study.schemas import VisitIn
from app.tables.jobs import Job, JobStatus
from app.tables.participants import Participant
from app.tables.sessions import Controller
from app.tables.visits import Visit

LEARNED_KINDS = ("trained", "distilled")
_WASHOUT_MINUTES = 5.0


class Progress(Protocol):
    """Called with how far the loop is."""

    def say(self, code: str, what: str) -> None:
        """Report the present activity."""

    def session_held(self, code: str) -> None:
        """Count one more session of the study."""

    def job(self, code: str, share: float) -> None:
        """Report the progress of the present job, 0-1; 1 ends it."""


def refuse_foreign(participant: Participant, caller: Caller) -> None:
    """Raise Conflict for a participant that the simulation did not enrol."""
    enrolled_by = participant.settings[0].created_by
    if enrolled_by != caller.label:
        raise Conflict(
            f"Participant {participant.code} was enrolled by {enrolled_by}, not by a simulated study; it is left alone.",
            "Choose other participants, or another data folder (BETALOOP_DATA_DIR).",
        )


@dataclass(frozen=True)
class Signer:
    """A simulated clinician with the password that a signature asks for again."""

    caller: Caller
    password: str


@dataclass
class ParticipantLoop:
    """All visits of one participant.

    Args:
        design: the study. remembered: its seed and its first day. caller: the simulated engineer and coordinator, who uploads and drafts.
        signer: the simulated clinician who signs what the other drafted.
        progress: called with how far the loop is. check_worker: raises when no worker runs any more.
    """

    code: str
    design: Design
    remembered: Remembered
    caller: Caller
    signer: Signer
    progress: Progress
    check_worker: Callable[[], None]

    def run(self) -> None:
        """Continue the study from its present state.

        Raises:
            Conflict: the participant exists, and was not enrolled by this simulation. BetaloopError: a job failed.
        """
        with self._transaction() as db:
            self._participant(db)
        for number in range(1, self.design.visits + 1):
            self._visit(number)

    @contextmanager
    def _transaction(self) -> Iterator[Session]:
        with transaction() as db:
            set_actor(db, self.caller.label, self.caller.user_id)
            yield db

    def _participant(self, db: Session) -> Participant:
        try:
            found = study_repository.participant_by_code(db, self.code, self.caller)
        except NotFound:
            return enrolment.enrol(db, ParticipantIn.model_validate(participant_body(self.code)), self.caller)
        refuse_foreign(found, self.caller)
        return found

    def _visit(self, number: int) -> None:
        day = self.remembered.first + (number - 1) * BETWEEN_VISITS
        collects = number <= self.design.preset.random_visits
        with self._transaction() as db:
            person = self._participant(db)
            visit = study_repository.visit_by_number(db, person.id, number)
            if visit is None:
                note = "Simulated: the participant is synthetic and not fitted to a patient."
                visit = visits.add_visit(db, person, VisitIn(number=number, date=day, note=note), self.caller)
            if plans.live_plan(db, visit.id) is None:
                if not collects:
                    self._learn(db, person, number)
                self._draft(db, person, visit, collects)
            if not collects:
                self.progress.job(self.code, 1.0)
            self._approve(db, visit)
            with TemporaryDirectory(prefix="betaloop-tablet-") as tablet:
                self._hold(db, visit, day, Path(tablet))

    def _hold(self, db: Session, visit: Visit, day: dt.date, tablet: Path) -> None:
        """Run the sessions of the signed plan that have no recording yet, and confirm all into their slots in one step.

        Raises:
            BetaloopError: a planned session is missing although the day is over, which would be a fault of the simulator.
        """
        the_day = VisitDay(visit, self.design.seed, dt.datetime.combine(day, MORNING), tablet, self.caller)
        rows = slots.compare(db, visit, self.caller).rows
        lines = [row.line for row in rows if row.line is not None]
        waiting = {row.line.item.id for row in rows if row.line is not None and row.session is None}
        for line in lines:
            if line.item.id in waiting:
                self.progress.say(self.code, f"visit {visit.number}: {_name(line)}")
                the_day.hold(db, line.item, line.start_minute)
            self.progress.session_held(self.code)
        the_day.end(db, lines[0].item.plan_id)
        self._fill(db, visit)
        db.expire_all()
        for row in slots.compare(db, visit, self.caller).rows:
            if row.line is not None and row.session is not None:
                the_day.enter_missing(db, row.session, row.line.item, row.line.start_minute)

    def _learn(self, db: Session, person: Participant, number: int) -> None:
        """Run the job before a visit, the one already begun for it or a new one, and wait for its end."""
        wanted = number - self.design.preset.random_visits
        rows = [job for kind in ("pipeline", NEXT_GENERATION) for job in jobs.of_kind(db, person.id, kind)]
        begun = sorted(
            (job for job in rows if job.status not in (JobStatus.FAILED, JobStatus.CANCELLED)), key=lambda job: (job.created_at, job.id)
        )
        job_id = begun[wanted - 1].id if len(begun) >= wanted else self._start(db, person, number).id
        db.commit()
        while not (view := look(job_id)).status.ended:
            self.check_worker()
            step = next((s.title for s in view.steps if s.status == JobStatus.RUNNING), "waiting for the worker")
            self.progress.say(self.code, f"before visit {number}: {step}")
            self.progress.job(self.code, min(view.progress, 0.99))
            time.sleep(POLL_S)
        if view.status != JobStatus.SUCCEEDED:
            raise BetaloopError(
                f"The job before visit {number} of {self.code} {view.status}: {view.error or 'no reason given'}",
                "Look at its page under Jobs, then start the simulation again: it goes on from here.",
            )

    def _start(self, db: Session, person: Participant, number: int) -> Job:
        """Start the job before a visit: the next generation from what did best by the posterior, or a pipeline from scratch.

        The next generation judges the tested policies with the last visit's sessions, as for any participant; there is no second rule here.
        """
        size = self.design.preset
        params = size.pipeline | {"seed": (self.design.seed + 100 * number) % 10**6}
        if self.design.fine_tunes(number) and tested_policies(db, person):
            wanted = NextGenerationParams.model_validate(params | {"parents": size.policies_per_kind})
            return next_generation.start(db, person, wanted, self.caller)
        return start_job(db, person, "pipeline", params, self.caller).job

    def _draft(self, db: Session, person: Participant, visit: Visit, collects: bool) -> None:
        """Draft the visit: random sessions alone at first, then policies. A session without stimulation ends each day."""
        size = self.design.preset
        chosen, overrides = ([], []) if collects else self._chosen(db, person)
        draft = PlanIn(
            policy_ids=chosen,
            overrides=overrides,
            random_sessions=size.random_sessions if collects else 0,
            minutes_per_session=float(size.session_minutes),
            washout_minutes=_WASHOUT_MINUTES,
            no_dbs=True,
            seed=(self.design.seed + visit.number) % planning.MAX_SEED,
            note="Drafted by the simulated study"
            + (", to collect." if collects else " from the first policies of each kind in the ranking."),
        )
        needed = total_minutes(len(chosen), planning.rules_of(draft))
        planning.draft_plan(db, visit, draft.model_copy(update={"total_minutes": max(needed, draft.total_minutes)}), self.caller)

    def _chosen(self, db: Session, person: Participant) -> tuple[list[int], list[OverrideIn]]:
        """Choose the first policies of each kind in the ranking, at most one of them to test with care.

        Unsafe ones fill empty places, with a reason: no person is harmed here, and an arm without sessions measures nothing.
        """
        found = current(db, person, self.caller).assessment
        fit = [a for a in found.candidates if a.decided and not a.policy.retired_reason]
        fit.sort(key=lambda a: a.decided is not None and a.decided.needs_override)  # stable: the ranking's order otherwise
        careful = [a for a in fit if a.decided and a.decided.decision == "test_with_care"]
        fit = [a for a in fit if a not in careful[1:]]
        each = self.design.preset.policies_per_kind
        chosen = [a.policy.id for kind in LEARNED_KINDS for a in [a for a in fit if a.policy.kind == kind][:each]]
        unsafe = [a.policy.id for a in fit if a.policy.id in chosen and a.decided and a.decided.needs_override]
        return chosen, [OverrideIn(policy_id=i, reason="a simulated participant: its arm would be empty without it") for i in unsafe]

    def _approve(self, db: Session, visit: Visit) -> None:
        plan = plan_view.read_plan(db, visit, self.caller).plan
        if plan.status == "draft":
            planning.approve_plan(db, visit, self.signer.caller, self.signer.password, plan.id)
            db.commit()

    def _fill(self, db: Session, visit: Visit) -> None:
        """Confirm the visit's sessions into the slots of its signed plan.

        Raises:
            BetaloopError: a planned session is missing although the day is over, which would be a fault of the simulator.
        """
        found = slots.compare(db, visit, self.caller)
        if found.missing:
            positions = ", ".join(str(line.item.position) for line in found.missing)
            raise BetaloopError(f"Visit {visit.number} of {self.code} took place without its planned sessions {positions}.")
        if found.waiting:
            slots.confirm(db, visit, self.caller)
            db.commit()


def _name(line: PlanLine) -> str:
    return f"session {line.item.position}, {CONTROLLER_NAMES[Controller(line.item.controller)]}" + (
        f" ({line.policy.name})" if line.policy else ""
    )
