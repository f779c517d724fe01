"""Design of the demo's synthetic study: participants, visits, sessions and their files. Nothing in here touches the service."""

from __future__ import annotations

import datetime as dt
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from ml.designs import DesignedSession, DesignSettings, lay_out
from ml.population import PARTICIPANTS, SimulatedSession, rcs_session_zip, run_session, session_table_csv
from ml.trajectories import SessionTrajectory

VISITS = {"P1": 3, "P2": 3, "P3": 2, "P4": 2}
"""First visits, at which nothing but random sessions, cDBS and no DBS ran."""
TESTED_VISITS = {"P3": 4, "P4": 4}
"""Visits after them that tested policies; their sessions are stored with the package (`demo_data`)."""
DAY = ("random", "cdbs", "random", "no_dbs", "cdbs", "random")
MINUTES = {"random": 10, "cdbs": 10, "no_dbs": 5}
BETWEEN_VISITS = dt.timedelta(days=28)
NEXT_VISIT_IN = {"P1": dt.timedelta(days=14), "P2": dt.timedelta(days=1), "P3": dt.timedelta(days=6), "P4": dt.timedelta(days=20)}
"""From the day on which the demo is begun to the visit that has no sessions yet."""
MORNING = dt.time(9, 0, tzinfo=dt.UTC)
BETWEEN_SESSIONS = dt.timedelta(minutes=20)
_FIRST_SESSION = dt.timedelta(minutes=5)
DEVICE_PARTICIPANT = "P1"
"""This participant's sessions arrive as RC+S folders, the others' as tables."""
_STEPS_PER_MINUTE = 30
_LEAD_STEPS = 10
_DEVICE_STARTS_S = 5
"""Seconds from the start of a simulated device recording to its first sample."""


def device_session(code: str) -> bool:
    """Decide if the participant's sessions arrive as device recordings, whose start must be stated."""
    return code == DEVICE_PARTICIPANT


def session_file(stem: str, simulated: SimulatedSession, begins: dt.datetime) -> tuple[str, bytes]:
    """Name and bytes of a simulated session's file: an RC+S folder or a table; `begins` is when its step 0 begins."""
    if device_session(simulated.participant):
        recording_starts = begins - dt.timedelta(seconds=_DEVICE_STARTS_S + 2 * simulated.lead_beta.size)
        return f"{stem}.zip", rcs_session_zip(simulated, started_ms=round(1000 * recording_starts.timestamp()))
    return f"{stem}.csv", session_table_csv(simulated)


@dataclass(frozen=True)
class DemoSession:
    """One session of the demo; simulated when its file is asked for."""

    code: str
    visit: int
    ordinal: int
    controller: str
    begins: dt.datetime
    design: DesignedSession | None = None

    @cached_property
    def simulated(self) -> SimulatedSession:
        """The session's numbers: the same at every start."""
        steps = MINUTES[self.controller] * _STEPS_PER_MINUTE
        return run_session(
            self.code,
            self.controller if self.design is None else self.design.first_steps(steps),  # type: ignore[arg-type]
            visit=self.visit,
            hour=(self.begins.hour - 9) + self.begins.minute / 60,
            seed=1000 * self.visit + self.ordinal,
            steps=steps,
            lead_steps=_LEAD_STEPS,
            resolution_ma=0.1,
        )

    @property
    def started_at(self) -> dt.datetime | None:
        """Start of the session proper: a device's recording begins with the window before it; a table states it by its times."""
        return self.begins if device_session(self.code) else None

    def trajectory(self, session_id: int) -> SessionTrajectory:
        """Return the session as learning reads it."""
        ran = self.simulated
        return SessionTrajectory(
            session_id=session_id,
            visit=self.visit,
            controller=self.controller,
            lead_beta=ran.lead_beta,
            beta=ran.beta,
            amplitude=ran.amplitude,
            qoc=ran.qoc,
            random_bound=PARTICIPANTS[self.code].mdp_settings().bound if self.design else None,
            holds=self.design.holds if self.design else (),
        )

    def file(self) -> tuple[str, bytes]:
        """Name and bytes of the session's file."""
        return session_file(f"{self.code}-visit{self.visit}-session{self.ordinal}", self.simulated, self.begins)

    def conditions(self) -> dict[str, Any] | None:
        """Return a random session's drawn design for the REST interface; None for other sessions."""
        if self.design is None:
            return None
        holds = [asdict(d) for d in self.design.decisions]
        stated = {"design": self.design.design, "seed": self.design.seed, "reason": "laid out before the visit"}
        return stated | {"design_parameters": {"level": self.design.level, "holds": holds}}

    def qoc(self) -> dict[str, Any]:
        """Return the end-of-session QoCs for the REST interface."""
        return asdict(self.simulated.qoc)


@dataclass(frozen=True)
class DemoVisit:
    """One visit. Those that tested policies have no simulated sessions here; the last one has none at all: it waits for its day."""

    number: int
    begins: dt.datetime
    sessions: tuple[DemoSession, ...]

    @property
    def date(self) -> dt.date:
        """The day of the visit."""
        return self.begins.date()

    @property
    def first_session(self) -> dt.datetime:
        """Start time of its first session."""
        return self.begins + _FIRST_SESSION


def participant_body(code: str) -> dict[str, Any]:
    """Build a participant for the REST interface, with the settings that its model suggests."""
    model = PARTICIPANTS[code]
    return {
        "code": code,
        "synthetic": True,
        "settings": {
            "xi_beta": model.reference.xi_beta,
            "beta_unit": "uV",
            "beta_source": "time_domain",
            "c2": model.c2,
            "c3": model.c3,
            "c4": model.c4,
            "cdbs_amplitude_ma": model.cdbs_amplitude_ma,
        },
    }


def characteristics_body(code: str) -> dict[str, Any]:
    """Build a participant's characteristics for the REST interface, as its model has them."""
    model = PARTICIPANTS[code]
    programme = model.programme
    contacts = [("C" if number == 16 else str(number)) + "+" for number in programme.anodes] + [
        f"{number}-" for number in programme.cathodes
    ]
    lead = {
        "hemisphere": model.hemisphere,
        "target": "stn",
        "sensing": f"{programme.sense_plus}-{programme.sense_minus}",
        "stimulating": "".join(contacts),
    }
    doses = [{"drug": "levodopa", "mg": 100, "at": f"{MORNING.hour + hour:02.0f}:00"} for hour in model.regimen.levodopa_h]
    known = {"leads": [lead], "symptoms": ["tremor", "bradykinesia"], "hand": model.hand, "medication": doses}
    return {"version": 0, "characteristics": known, "reason": "stated at enrolment"}


def designs(code: str) -> tuple[DesignedSession, ...]:
    """Design the participant's random sessions: the stratified design of a new participant, over the demo's visits."""
    wanted = DesignSettings(
        visits=VISITS[code], sessions=DAY.count("random"), steps=MINUTES["random"] * _STEPS_PER_MINUTE, seed=list(PARTICIPANTS).index(code)
    )
    return lay_out(wanted)


def demo_visits(code: str, today: dt.date) -> list[DemoVisit]:
    """List the participant's visits, a month apart; the next one is `NEXT_VISIT_IN` after `today`."""
    visits = []
    designed = iter(designs(code))
    held = VISITS[code] + TESTED_VISITS.get(code, 0)
    first = dt.datetime.combine(today + NEXT_VISIT_IN[code] - held * BETWEEN_VISITS, MORNING)
    for number in range(1, held + 2):
        day = first + BETWEEN_VISITS * (number - 1)
        sessions = tuple(
            DemoSession(
                code,
                number,
                i + 1,
                controller,
                day + _FIRST_SESSION + BETWEEN_SESSIONS * i,
                next(designed) if controller == "random" else None,
            )
            for i, controller in enumerate(DAY if number <= VISITS[code] else ())
        )
        visits.append(DemoVisit(number, day, sessions))
    return visits


def trajectories(code: str) -> list[SessionTrajectory]:
    """Return the sessions of the first visits as learning reads them."""
    any_day = dt.date(2026, 1, 1)
    sessions = [session for visit in demo_visits(code, any_day) for session in visit.sessions]
    return [session.trajectory(number) for number, session in enumerate(sessions, start=1)]
