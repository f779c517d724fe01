"""One planned session of the study in silico: run from its bundle, entered on the clinic day, and uploaded into its slot."""

from __future__ import annotations

import datetime as dt
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, UUID, uuid5

import numpy as np
from pydantic import TypeAdapter
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.ingest.uploads import service as ingest
from app.planning.visit_day import service as clinic_day
from app.planning.visit_day.schemas import EntryIn
from app.platform.errors import BetaloopError
from app.simulation.demo.study import device_session, session_file
from app.simulation.tablet import Moment, run_slot_of
from app.study.schemas import QocIn
from app.study.sessions import changes
from app.study.settings import mdp_settings
from app.tables.participants import Participant
from app.tables.plans import PlanItem
from app.tables.sessions import Controller, StudySession
from app.tables.visits import Visit
from ml.outcomes import BY_FIELD
from ml.population import SimulatedSession, run_session
from ml.population.outcomes import GRASP_TEST_S, MEASURED, Outcomes

RESOLUTION_MA = 0.1
"""What an RC+S delivers."""
STEPS_PER_MINUTE = 30
_BETWEEN_ENTRIES = dt.timedelta(seconds=10)
_ENTRY: TypeAdapter[Any] = TypeAdapter(EntryIn)


@dataclass(frozen=True)
class Held:
    """A session that was run, again or for the first time: the file that is uploaded, when it ended, what was measured."""

    file: tuple[str, bytes]
    ended: dt.datetime
    outcomes: Outcomes


@dataclass(frozen=True)
class VisitDay:
    """The sessions of one visit.

    Args:
        seed: of the study. first: start of the first session. caller: who runs the day. tablet: folder of the day's tablet, new after a
            kill. A session cut short then runs again from its beginning, with the same numbers.
    """

    visit: Visit
    seed: int
    first: dt.datetime
    tablet: Path
    caller: Caller
    _held: dict[int, Held] = field(default_factory=dict)

    def hold(self, db: Session, item: PlanItem, start_minute: float) -> None:
        """Run a session, enter its outcomes and upload its file, without confirming it into its slot. Commits.

        Raises:
            BetaloopError: it may not run, or its file was not understood: a fault of the decoder or of the simulator.
        """
        held = self._run(db, item, start_minute, self.tablet)
        begins = self._moment(item, start_minute).begins
        self._send(db, item.plan_id, _entries(self.visit.participant.code, item, begins, held.ended, held.outcomes))
        log = item.controller != Controller.NO_DBS
        stated = ingest.state_session(
            db,
            self.visit.participant,
            self.visit.number,
            None if log else Controller.NO_DBS,  # a log says itself which session it is of
            started_at=begins if not log and device_session(self.visit.participant.code) else None,
        )
        name, content = held.file
        outcome = ingest.receive(db, self.visit.participant, stated, [ingest.Incoming(name, io.BytesIO(content))], self.caller)
        if not outcome.usable:
            problems = "; ".join(str(r.problem) for f in outcome.files for r in f.reports if r.problem)
            raise BetaloopError(f"The simulated file {name} was not understood: {problems}.")

    def end(self, db: Session, plan_id: int) -> None:
        """Enter that the stimulator is back on clinical settings."""
        at = self.first + dt.timedelta(hours=12)
        entry = {"uuid": str(_named(f"plan {plan_id}", "clinical_settings")), "kind": "clinical_settings", "device_time": at.isoformat()}
        self._send(db, plan_id, [entry])

    def enter_missing(self, db: Session, session: StudySession, item: PlanItem, start_minute: float) -> None:
        """Enter the outcomes of a confirmed session that its day does not take down, as the watch gave them; known ones stay."""
        missing = [name for name in MEASURED if session.qoc is None or session.qoc.value(BY_FIELD[name]) is None]
        if not missing:
            return
        # a session done before a stop is run again, on a tablet of its own: its time is before that of the day's
        qoc = self._run(db, item, start_minute, self.tablet / f"again-{item.position}").outcomes.qoc
        values = {name: getattr(qoc, name) for name in missing} | {"sure": missing, "reason": "as the simulated watch gave it"}
        changes.record_qoc(db, session, QocIn.model_validate(values), self.caller)

    def _run(self, db: Session, item: PlanItem, start_minute: float, tablet: Path) -> Held:
        """Return the session's results, the same whenever they are asked for."""
        if item.position not in self._held:
            at = self._moment(item, start_minute)
            off = item.controller == Controller.NO_DBS
            self._held[item.position] = self._switched_off(item, at) if off else self._on_tablet(db, item, at, tablet)
        return self._held[item.position]

    def _on_tablet(self, db: Session, item: PlanItem, at: Moment, tablet: Path) -> Held:
        ran = run_slot_of(db, self.visit, item.position, at, tablet, self.caller)
        db.commit()
        return Held((f"{_stem(self.visit, item)}.csv", ran.log), ran.ended, ran.outcomes)

    def _switched_off(self, item: PlanItem, at: Moment) -> Held:
        """Record a session without stimulation by the device alone: it has no bundle."""
        simulated = without_stimulation(self.visit.participant, at, round(item.minutes * STEPS_PER_MINUTE))
        file = session_file(_stem(self.visit, item), simulated, at.begins)
        return Held(file, at.begins + dt.timedelta(minutes=item.minutes), simulated.outcomes)

    def _moment(self, item: PlanItem, start_minute: float) -> Moment:
        noise = int(np.random.default_rng([self.seed, self.visit.number, item.position]).integers(0, 2**63))
        begins = (self.first + dt.timedelta(minutes=start_minute)).replace(microsecond=0)
        return Moment(begins=begins, hour=start_minute / 60, visit=self.visit.number, seed=noise, study_seed=self.seed)

    def _send(self, db: Session, plan_id: int, entries: list[dict[str, Any]]) -> None:
        """Send the entries as the day's page does; existing ones stay. Commits. Raises BetaloopError for a refused entry."""
        results = clinic_day.add_entries(db, self.visit, plan_id, [_ENTRY.validate_python(e) for e in entries], self.caller)
        refused = [f"{r.detail} {r.hint}" for r in results if r.outcome == "refused"]
        if refused:
            raise BetaloopError(f"The clinic day of visit {self.visit.number} refused an entry: {refused[0]}")
        db.commit()


def without_stimulation(participant: Participant, at: Moment, steps: int) -> SimulatedSession:
    """Simulate a session without stimulation, as the stimulator records it."""
    return run_session(
        participant.code,
        "no_dbs",
        visit=at.visit,
        hour=at.hour,
        seed=at.seed,
        steps=steps,
        lead_steps=mdp_settings(participant.current_settings).window,
        resolution_ma=RESOLUTION_MA,
        study_seed=at.study_seed,
        name="no_dbs",
    )


def _stem(visit: Visit, item: PlanItem) -> str:
    return f"{visit.participant.code}-visit{visit.number}-session{item.position}"


def _named(of: str, kind: str) -> UUID:
    """Derive the identifier of an entry, the same when the study goes on after a stop."""
    return uuid5(NAMESPACE_URL, f"betaloop simulated study, {of}, {kind}")


def _entries(code: str, item: PlanItem, begins: dt.datetime, ended: dt.datetime, outcomes: Outcomes) -> list[dict[str, Any]]:
    """List the entries of the clinic day about one session: its times, rating and grasp test, and no side effects."""
    asked: list[tuple[str, Mapping[str, Any]]] = [
        ("rating", {"value": outcomes.qoc.rating}),
        ("grasp", _grasps(ended, outcomes)),
        *((kind, {"grade": "none"}) for kind in ("dyskinesia", "speech", "gait")),
        ("session_end", {}),
    ]
    times: list[tuple[str, Mapping[str, Any], dt.datetime]] = [("start", {}, begins), ("stop", {}, ended)]
    times += [(kind, payload, ended + (k + 1) * _BETWEEN_ENTRIES) for k, (kind, payload) in enumerate(asked)]
    of = f"{code}, session {item.id}"
    return [
        {
            "uuid": str(_named(of, kind)),
            "plan_item_id": item.id,
            "kind": kind,
            "payload": payload,
            "device_time": at.isoformat(),
            "clock_offset_ms": 0,
        }
        for kind, payload, at in times
    ]


def _grasps(ended: dt.datetime, outcomes: Outcomes) -> dict[str, Any]:
    """Build the grasp test of the session's last seconds: tapped, or typed if fewer than two fists were opened."""
    taps = [round(float(t), 3) for t in outcomes.open_fist_s]
    if len(taps) < 2:
        return {"method": "typed", "hz": outcomes.qoc.grasp_hz}
    began = ended - dt.timedelta(seconds=GRASP_TEST_S)
    return {"method": "taps", "taps_s": taps, "began_at": began.isoformat(), "ended_at": ended.isoformat()}
