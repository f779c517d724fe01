"""Content of the demo's study, in the order in which a clinic would enter it: visits, sessions, rankings, plans, and events.

All of it goes through the REST interface. Only policies learned earlier are added by their service function, after their snapshot was
compared with the sessions that they were learned on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from app.accounts import repository
from app.accounts import service as accounts
from app.learning.learned_earlier import Learned, add_learned
from app.learning.snapshots import take_snapshot
from app.platform.database import now, transaction
from app.settings import get_settings
from app.simulation.demo.accounts import ADMIN, CLINICIAN, ENGINEER, password
from app.simulation.demo.data import REPEATS, SESSION_MINUTES, WASHOUT_MINUTES, Generation, RecordedSession, Story, read
from app.simulation.demo.loader import Door, LoadFailed, State, Step, follow, run_all, show
from app.simulation.demo.study import DemoSession, characteristics_body, demo_visits, participant_body, trajectories
from app.study import repository as study
from ml.outcomes import FIELDS
from ml.population import PARTICIPANTS
from ml.trajectories import ReplayBuffer

METHODS: Final = ("wis",)
"""Methods besides the posterior, which ranks: the fastest one; methods that model beta are refitted for each controller."""
DRAFTED: Final = "Drafted for the demo."


@dataclass
class People:
    """Users of the demo, each acting through the REST interface."""

    admin: Door
    engineer: Door
    clinician: Door

    @classmethod
    def at(cls, url: str) -> People:
        """Make a token for each user, for this run."""
        return cls(*(Door(url, _token(email)) for email in (ADMIN, ENGINEER, CLINICIAN)))


def _token(email: str) -> str:
    with transaction("demo") as db:
        return accounts.create_token(db, email, f"demo loader {now():%Y-%m-%d %H:%M:%S.%f}")


@dataclass
class Participant:
    """The steps of one participant."""

    code: str
    state: State
    people: People
    visit_ids: dict[int, int] = field(default_factory=dict)

    @cached_property
    def visits(self) -> dict[int, Any]:
        """By number."""
        return {v.number: v for v in demo_visits(self.code, self.state.begun)}

    @cached_property
    def story(self) -> Story:
        """The participant's story, as stored with the package."""
        return read(self.code)

    def step(self, name: str, do: Callable[..., None], *given: Any) -> Step:
        """Make a step under this participant's name."""
        return f"{self.code} {name}", partial(do, *given)

    def early(self) -> list[Step]:
        """List the steps of enrolment and of the first visits, at which random sessions were recorded."""
        steps = [self.step("enrol", self._enrol)]
        for number, visit in self.visits.items():
            steps.append(self.step(f"visit {number}", self._add_visit, number))
            steps += [self.step(f"visit {number} session {s.ordinal}", self._simulated, s) for s in visit.sessions]
        return steps

    def with_policies(self) -> list[Step]:
        """List the early steps, then those of visits that tested policies, each from its plan to its confirmed sessions."""
        steps = self.early()
        for number in sorted({s.visit for s in self.story.sessions}):
            generation = next(g for g in reversed(self.story.generations) if g.visit <= number)
            steps += self.learned(generation) if generation.visit == number else []
            steps.append(self.step(f"visit {number} plan", self.plan, number, generation))
            held = [s for s in self.story.sessions if s.visit == number]
            steps += [self.step(f"visit {number} session {s.position}", self._recorded, s) for s in held]
            steps.append(self.step(f"visit {number} confirm", self._confirm, number))
        return steps

    def learned(self, generation: Generation) -> list[Step]:
        """List the steps that add the policies learned before a visit, and rank them."""
        number = generation.visit
        return [
            self.step(f"visit {number} policies", self._take_over, generation),
            self.step(f"visit {number} ranking", self.rank, f"before visit {number}"),
        ]

    def _enrol(self) -> None:
        self.people.admin.post("/participants", participant_body(self.code), may_exist=True)
        if not self.people.admin.get(f"/participants/{self.code}/characteristics"):
            self.people.admin.put(f"/participants/{self.code}/characteristics", characteristics_body(self.code))

    def _add_visit(self, number: int) -> None:
        body = {"number": number, "date": self.visits[number].date.isoformat()}
        self.people.admin.post(f"/participants/{self.code}/visits", body, may_exist=True)

    def visit_id(self, number: int) -> int:
        """Return a visit's id in addresses, asked for once."""
        if number not in self.visit_ids:
            listed = self.people.admin.get(f"/participants/{self.code}/visits?limit=200")["items"]
            self.visit_ids = {v["number"]: v["id"] for v in listed}
        return self.visit_ids[number]

    def _simulated(self, session: DemoSession) -> None:
        """Upload a session of the first visits: its file, its outcomes, and how its amplitudes were drawn."""
        name, content = session.file()
        fields = {"participant": self.code, "visit": str(session.visit), "controller": session.controller}
        if session.started_at is not None:
            fields["started_at"] = session.started_at.isoformat()
        stored = self.people.admin.upload(fields, name, content)["sessions"][0]["id"]
        self._outcomes(stored, session.qoc())
        if (conditions := session.conditions()) is not None:
            self.people.admin.put(f"/sessions/{stored}/conditions", conditions)

    def _outcomes(self, session_id: int, qoc: dict[str, Any]) -> None:
        self.people.admin.put(f"/sessions/{session_id}/qoc", qoc | {"sure": list(FIELDS)})

    def _recorded(self, session: RecordedSession) -> None:
        """Upload a session of a visit with policies, as recorded when the files were made."""
        begins = self.morning(session.visit) + timedelta(minutes=session.start_minute)
        fields = {
            "participant": self.code,
            "visit": str(session.visit),
            "controller": session.controller,
            "started_at": begins.isoformat(),
        }
        if session.policy is not None:
            fields["policy"] = session.policy
        content = session.table(PARTICIPANTS[self.code].cdbs_amplitude_ma)
        stored = self.people.admin.upload(fields, f"{self.code}-visit{session.visit}-session{session.position}.csv", content)
        self._outcomes(stored["sessions"][0]["id"], session.qoc)

    def morning(self, number: int) -> datetime:
        """Return the start time of a visit's first session."""
        begins: datetime = self.visits[number].first_session
        return begins

    def _take_over(self, generation: Generation) -> None:
        """Store the policies that were learned before a visit, on a snapshot of the sessions until then."""
        buffer = self.learnt_on(generation)
        with transaction(ENGINEER) as db:
            user = repository.user_by_email(db, ENGINEER)
            assert user is not None
            caller = accounts.caller_of(user)
            participant = study.participant_by_code(db, self.code, caller)
            snapshot = take_snapshot(db, participant, caller)
            for p in generation.policies:
                learned = Learned(
                    name=p.name,
                    kind=p.kind,
                    algorithm=p.algorithm,
                    teacher=p.teacher,
                    parent=p.parent,
                    config=p.config,
                    metrics=p.metrics,
                    onnx=p.onnx,
                    code_version=self.story.made_by,
                )
                add_learned(db, participant, snapshot, buffer, learned, caller)

    def learnt_on(self, generation: Generation) -> ReplayBuffer:
        """Return the sessions that a generation was learned on."""
        sessions = trajectories(self.code) + [
            s.trajectory(100 + k, PARTICIPANTS[self.code].cdbs_amplitude_ma, None) for k, s in enumerate(self.story.sessions)
        ]
        return ReplayBuffer(PARTICIPANTS[self.code].mdp_settings(), tuple(sessions[: generation.sessions]), "uV", "time_domain")

    def rank(self, when: str) -> None:
        """Rank the policies by the sessions so far."""
        name = f"{self.code} {when}"
        if name not in self.state.jobs:
            asked = {"kind": "evaluate", "preset": "quick", "methods": list(METHODS)}
            self.state.started(name, self.people.engineer.post(f"/participants/{self.code}/jobs", asked)["id"])
        try:
            self.people.engineer.wait(self.state.jobs[name])
        except LoadFailed:
            self.state.forget(name)
            raise

    def plan(self, number: int, generation: Generation) -> None:
        """Draft a visit and have another person sign it, unless that was done before a stop."""
        at = f"/visits/{self.visit_id(number)}/plan"
        if self.people.engineer.has(at):
            plan = self.people.engineer.get(at)
            if plan["status"] == "approved":
                return
        known = {p["name"]: p["id"] for p in self.people.engineer.get(f"/participants/{self.code}/policies?limit=200")["items"]}
        draft = {
            "policy_ids": [known[name] for name in generation.tested],
            "order": "stated",
            "repeats": REPEATS,
            "no_dbs": True,
            "minutes_per_session": SESSION_MINUTES,
            "washout_minutes": WASHOUT_MINUTES,
            "note": DRAFTED,
        }
        plan = self.people.engineer.post(at, draft)
        self.people.clinician.post(f"{at}/approve", {"password": password(get_settings().data_dir), "plan_id": plan["id"]})

    def _confirm(self, number: int) -> None:
        """Put the sessions of a visit into the slots of its plan."""
        self.people.admin.post(f"/visits/{self.visit_id(number)}/slots/confirm", {})


def p1(participant: Participant) -> list[Step]:
    """List the steps of the first visits only: the first ranking is computed while a user watches."""
    return participant.early()


def p2(participant: Participant) -> list[Step]:
    """List the steps up to the next visit: margins locked, the visit planned and signed, with a bundle for each session."""
    number = participant.story.generations[0].visit
    return [
        *participant.early(),
        participant.step("margins", _lock_margins, participant),
        *participant.learned(participant.story.generations[0]),
        participant.step(f"visit {number} plan", participant.plan, number, participant.story.generations[0]),
        participant.step(f"visit {number} bundles", _take_bundles, participant, number),
    ]


def _lock_margins(participant: Participant) -> None:
    at = f"/participants/{participant.code}/margins"
    if not participant.people.clinician.get(f"{at}/locks"):
        version = participant.people.clinician.get(at)[-1]["version"]
        reason = "Fixed before the first visit that tests policies."
        sent = {"version": version, "reason": reason, "password": password(get_settings().data_dir)}
        participant.people.clinician.post(f"{at}/locks", sent)


def _take_bundles(participant: Participant, number: int) -> None:
    at = f"/visits/{participant.visit_id(number)}/plan"
    for session in participant.people.engineer.get(at)["sessions"]:
        if session["controller"] != "no_dbs":
            participant.people.engineer.read(f"{at}/sessions/{session['position']}/bundle")


def p3(participant: Participant) -> list[Step]:
    """List the steps of six visits, three of them with policies, and of a mild adverse event."""
    return [
        *_gated(participant),
        participant.step("adverse event", _adverse_event, participant),
        participant.step("ranking", participant.rank, "after the last visit"),
    ]


def p4(participant: Participant) -> list[Step]:
    """List the steps of six visits, three of them with policies, and of a monitor's questions about values."""
    return [
        *_gated(participant),
        participant.step("data queries", _data_queries, participant),
        participant.step("open files", _open_files, participant),
        participant.step("ranking", participant.rank, "after the last visit"),
    ]


def _gated(participant: Participant) -> list[Step]:
    """List the steps of visits with policies. After the first such visit a clinician admits their sessions to later learning."""
    steps = participant.with_policies()
    first = participant.story.generations[0].visit
    after = 1 + next(k for k, (name, _) in enumerate(steps) if name.endswith(f"visit {first} confirm"))
    return [*steps[:after], participant.step("gate", _open_gate, participant), *steps[after:]]


def _open_gate(participant: Participant) -> None:
    at = f"/participants/{participant.code}/buffer-gate"
    if participant.people.clinician.get(at)["decision"] is None:
        participant.people.clinician.post(at, {"choice": "open", "reason": "No session was stopped; learn from what the policies met."})


def _session_of(participant: Participant, visit: int, controller: str) -> int:
    listed = participant.people.clinician.get(f"/visits/{participant.visit_id(visit)}/sessions?limit=200")["items"]
    return int(next(s["id"] for s in listed if s["controller"] == controller))


def _adverse_event(participant: Participant) -> None:
    last = participant.story.generations[-1].visit
    event = {
        "kind": "paraesthesia",
        "severity": "mild",
        "note": "Tingling in the hand for a minute after the start, gone by itself.",
        "session_id": _session_of(participant, last - 1, "rl"),
        "entry_key": f"demo {participant.code}",
    }
    participant.people.clinician.post(f"/participants/{participant.code}/adverse-events", event)


def _data_queries(participant: Participant) -> None:
    at = f"/participants/{participant.code}/data-queries"
    if participant.people.clinician.get(at):
        return
    last = participant.story.generations[-1].visit
    asked = {
        "session_id": _session_of(participant, last - 1, "no_dbs"),
        "field": "rating",
        "text": "Was this rating given during the session or after it?",
    }
    query = participant.people.clinician.post(at, asked)
    answer = {"state": "answered", "text": "At its end, before the stimulation was switched on again.", "entries": len(query["entries"])}
    participant.people.admin.post(f"/data-queries/{query['id']}/entries", answer)
    more = {
        "session_id": _session_of(participant, last, "rl"),
        "field": "grasp_hz",
        "text": "Please compare this frequency with the video.",
    }
    participant.people.clinician.post(at, more)


def _open_files(participant: Participant) -> None:
    """Upload files that need a person: a recording of an unstated controller, a table of unknown columns, and an unreadable file."""
    door, code = participant.people.admin, participant.code
    last = participant.story.generations[-1].visit + 1
    begins = participant.morning(last) + timedelta(hours=3)
    _, table = DemoSession(code, last, 90, "cdbs", begins).file()
    stated = {"participant": code, "visit": str(last), "confirm": "false", "started_at": begins.isoformat()}
    door.upload(stated, f"{code}-visit{last}-unstated.csv", table)
    unknown = "clock,band_power,current\n" + "".join(f"{2 * k},{1 + k % 3 / 10:.1f},3.0\n" for k in range(60))
    door.upload({"participant": code}, "watch.csv", unknown.encode(), may_be_unusable=True)
    door.upload({"participant": code}, "Report_Json_Session_Report.json", b'{"SessionDate": "cut short', may_be_unusable=True)


LINES: Final = {"P1": p1, "P2": p2, "P3": p3, "P4": p4}


def load(url: str, state_path: Path, console: Console | None = None) -> None:
    """Load the study, then start what trains in the background; returns once P1's first ranking is there."""
    shown = console or Console()
    state = State.at(state_path, now().date())
    if state.complete:
        return
    people = People.at(url)
    participants = {code: Participant(code, state, people) for code in LINES}
    columns = (TextColumn("  {task.description:<42}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=shown) as bars:
        bar = bars.add_task("Four participants, through the upload path", total=None)
        run_all(
            state,
            [LINES[code](participants[code]) for code in sorted(LINES, reverse=True)],
            lambda done, total: bars.update(bar, completed=done, total=total),
        )
    _say(shown, f"\n  Every page has its content: [underline]{url}[/]")
    _first_ranking(shown, url, state, people)
    state.complete = True
    state.save()


def _first_ranking(console: Console, url: str, state: State, people: People) -> None:
    """Compute P1's first ranking with the machine to itself; then start the next generations of P3 and P4 in the background."""
    first = "P1 first ranking"
    if first not in state.jobs:
        state.started(first, people.engineer.post("/participants/P1/jobs", {"kind": "pipeline", "preset": "quick"})["id"])
    job = show(console, follow(people.engineer, state.jobs[first]))
    if job["status"] != "succeeded":
        _say(console, f"  [bold red]The pipeline {job['status']}:[/] {job.get('error') or ''} See the Jobs page.")
    for code in ("P3", "P4"):
        name = f"{code} next generation"
        if name not in state.jobs:
            asked = {"kind": "next_generation", "preset": "quick"}
            state.started(name, people.engineer.post(f"/participants/{code}/jobs", asked)["id"])
    _say(console, f"  Ranked policies of P1: [underline]{url}/participants/P1/ranking[/]")
    _say(console, f"  P3 and P4 learn their next generation in the background: [underline]{url}/jobs[/]")


def _say(console: Console, line: str) -> None:
    console.print(line, soft_wrap=True, highlight=False)
