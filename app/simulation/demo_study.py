"""What the demo's synthetic study consists of: participants, visits, sessions and their files. Nothing in here touches the service."""

from __future__ import annotations

import datetime as dt
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from ml.designs import DesignedSession, DesignSettings, lay_out
from ml.population import PARTICIPANTS, SimulatedSession, rcs_session_zip, run_session, session_table_csv

VISITS = 3
"""Visits with data; one more is planned after them."""
DAY = ("random", "cdbs", "random", "no_dbs", "cdbs", "random")
MINUTES = {"random": 10, "cdbs": 10, "no_dbs": 5}
BETWEEN_VISITS = dt.timedelta(days=28)
NEXT_VISIT_IN = dt.timedelta(days=14)
MORNING = dt.time(9, 0, tzinfo=dt.UTC)
BETWEEN_SESSIONS = dt.timedelta(minutes=20)
DEVICE_PARTICIPANT = "P1"
"""This participant's sessions arrive as RC+S folders, the others' as tables."""
_STEPS_PER_MINUTE = 30
_LEAD_STEPS = 10
_DEVICE_STARTS_S = 5
"""Seconds from the start of a simulated device recording to its first sample."""


def device_session(code: str) -> bool:
    """Whether the participant's sessions arrive as device recordings, whose start must be stated."""
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

    def file(self) -> tuple[str, bytes]:
        """Name and bytes of the session's file."""
        return session_file(f"{self.code}-visit{self.visit}-session{self.ordinal}", self.simulated, self.begins)

    def conditions(self) -> dict[str, Any] | None:
        """What the design drew for a random session, for the REST interface; None for other sessions."""
        if self.design is None:
            return None
        holds = [asdict(d) for d in self.design.decisions]
        stated = {"design": self.design.design, "seed": self.design.seed, "reason": "laid out before the visit"}
        return stated | {"design_parameters": {"level": self.design.level, "holds": holds}}

    def qoc(self) -> dict[str, Any]:
        """End-of-session QoCs for the REST interface."""
        qoc = self.simulated.qoc
        return {"grasp_hz": qoc.grasp_hz, "rating": qoc.rating, "tremor_percent": qoc.tremor_percent}


@dataclass(frozen=True)
class DemoVisit:
    """One visit; the last has no session yet: it waits for a plan."""

    number: int
    date: dt.date
    sessions: tuple[DemoSession, ...]


def participant_body(code: str) -> dict[str, Any]:
    """A participant for the REST interface, with the settings that its model suggests."""
    model = PARTICIPANTS[code]
    return {
        "code": code,
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


def designs(code: str) -> tuple[DesignedSession, ...]:
    """What the participant's random sessions try: the stratified design of a new participant, over the demo's visits."""
    wanted = DesignSettings(
        visits=VISITS, sessions=DAY.count("random"), steps=MINUTES["random"] * _STEPS_PER_MINUTE, seed=list(PARTICIPANTS).index(code)
    )
    return lay_out(wanted)


def demo_visits(code: str, today: dt.date) -> list[DemoVisit]:
    """The participant's visits, a month apart; the next lies two weeks after `today`."""
    visits = []
    designed = iter(designs(code))
    first = dt.datetime.combine(today + NEXT_VISIT_IN - VISITS * BETWEEN_VISITS, MORNING)
    for number in range(1, VISITS + 2):
        day = first + BETWEEN_VISITS * (number - 1)
        sessions = (
            tuple(
                DemoSession(
                    code,
                    number,
                    i + 1,
                    controller,
                    day + BETWEEN_SESSIONS * i + dt.timedelta(minutes=5),
                    next(designed) if controller == "random" else None,
                )
                for i, controller in enumerate(DAY)
            )
            if number <= VISITS
            else ()
        )
        visits.append(DemoVisit(number, day.date(), sessions))
    return visits
