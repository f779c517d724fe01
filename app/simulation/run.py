"""`betaloop study simulate`: an in-silico study from the first visit to the last, with a worker of its own; interrupted, it goes on."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts import repository
from app.accounts import service as accounts
from app.accounts.permissions import SYSTEM, Caller
from app.analysis.pooled import TrialTime, trial_time
from app.platform.database import get_engine, new_session, now, transaction
from app.platform.errors import BetaloopError, Conflict
from app.platform.jobs.worker import run_worker
from app.settings import get_settings
from app.simulation.design import STATE_FILE, Design, remember
from app.simulation.loop import ParticipantLoop, Signer, refuse_foreign
from app.study import repository as study
from app.tables.accounts import Role

ACCOUNT = "simulated-clinician@simulation.example"
"""Account that enrols, uploads and drafts; no person can sign in with it, for its password is thrown away."""
SIGNER = "simulated-second-clinician@simulation.example"
"""Account that signs what the other drafted; every run draws a new password and throws it away afterwards."""
_LOCK = "betaloop simulated study"
_JOB_UNITS = 5.0
"""A job counts on the bar as this many sessions."""


def simulate(design: Design, console: Console | None = None, slots: int | None = None) -> Caller:
    """Run the study, or what is missing of it; returns the account it ran under.

    Args:
        design: what to simulate. console: where the progress bars go; stderr by default.
        slots: compute steps side by side; the installation's setting by default.

    Raises:
        Conflict: another simulation runs, or another study was begun in this data folder. BetaloopError: a job failed.
    """
    settings = get_settings()
    with _alone(), _worker(settings.worker_slots if slots is None else slots) as check_worker:
        caller, signer = _account(), _signer()
        _refuse_foreign(design, caller)
        remembered = remember(settings.data_dir / STATE_FILE, design, now().date())
        with _Bars(design, console or Console(stderr=True)) as bars:
            for code in design.participants:
                ParticipantLoop(code, design, remembered, caller, signer, bars, check_worker).run()
                bars.say(code, "all visits held")
    return caller


def _account() -> Caller:
    with transaction("simulated study") as db:
        user = repository.user_by_email(db, ACCOUNT)
        if user is None:
            user = accounts.add_user(db, ACCOUNT, Role.CLINICIAN, secrets.token_urlsafe(32), name="Simulated clinician")
        return accounts.caller_of(user)


def _signer() -> Signer:
    """Find or add the second person, with a new password for this run."""
    password = secrets.token_urlsafe(32)
    with transaction("simulated study") as db:
        user = repository.user_by_email(db, SIGNER)
        if user is None:
            user = accounts.add_user(db, SIGNER, Role.CLINICIAN, password, name="Simulated second clinician")
        else:
            accounts.set_password(db, user, password)
        return Signer(accounts.caller_of(user), password)


def _refuse_foreign(design: Design, caller: Caller) -> None:
    with new_session() as db:
        for participant in study.participants(db, SYSTEM, 10_000, 0)[0]:
            if participant.code in design.participants:
                refuse_foreign(participant, caller)


@contextmanager
def _alone() -> Iterator[None]:
    """Take the database's lock of simulations; it ends with this process."""
    with get_engine().connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        if not connection.scalar(text("select pg_try_advisory_lock(hashtextextended(:name, 0))"), {"name": _LOCK}):
            raise Conflict("A simulated study is running on this database already.", "Wait for its end, or stop it first.")
        try:
            yield
        finally:
            connection.execute(text("select pg_advisory_unlock(hashtextextended(:name, 0))"), {"name": _LOCK})


@contextmanager
def _worker(slots: int) -> Iterator[Callable[[], None]]:
    """Run a worker in a thread of this process; yield a function that raises when it has ended."""
    stop = threading.Event()
    failure: list[Exception] = []

    def work() -> None:
        try:
            run_worker(slots, stop)
        except Exception as error:  # handed to the thread that waits for the jobs
            failure.append(error)

    thread = threading.Thread(target=work, name="simulation-worker")
    thread.start()

    def check() -> None:
        if failure or not thread.is_alive():
            cause = failure[0] if failure else None
            raise BetaloopError("The worker of the simulation ended.", "Start it again: it goes on from here.") from cause

    try:
        yield check
    finally:
        stop.set()
        thread.join()


class _Bars:
    """A bar for each participant."""

    def __init__(self, design: Design, console: Console) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn())
        self._progress = Progress(*columns, TextColumn("{task.fields[what]}"), console=console)
        jobs = design.visits - design.preset.random_visits
        total = sum(design.expected_sessions(v) for v in range(1, design.visits + 1)) + jobs * _JOB_UNITS
        self._tasks: dict[str, TaskID] = {c: self._progress.add_task(c, total=total, start=False, what="") for c in design.participants}
        self._done = dict.fromkeys(design.participants, 0.0)
        self._said: dict[str, str] = {}

    def __enter__(self) -> _Bars:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def say(self, code: str, what: str) -> None:
        """Show the present activity."""
        if not self._progress.console.is_terminal and self._said.get(code) != what:
            self._progress.console.print(f"{code}, {what}", highlight=False)  # bars need a terminal; a log file gets lines
        self._said[code] = what
        self._progress.start_task(self._tasks[code])
        self._progress.update(self._tasks[code], what=what)

    def session_held(self, code: str) -> None:
        """Count one more session of the study."""
        self._advance(code, 1.0)

    def job(self, code: str, share: float) -> None:
        """Show the progress of the present job, 0-1; 1 ends it."""
        self._progress.update(self._tasks[code], completed=self._done[code] + _JOB_UNITS * share)
        if share >= 1.0:
            self._advance(code, _JOB_UNITS)

    def _advance(self, code: str, units: float) -> None:
        self._done[code] += units
        self._progress.update(self._tasks[code], completed=self._done[code])


# Report of a simulated study at its end: the paper's table of trial time.


def as_table(db: Session, codes: Sequence[str], caller: Caller) -> Table:
    """Tabulate the minutes per controller and participant, with the number of sessions in brackets."""
    trial = _trial(db, codes, caller)
    table = Table(title="Trial time, minutes (sessions)", caption="Synthetic participants, not fitted to patients.")
    table.add_column("Participant")
    for label in trial.labels:
        table.add_column(label, justify="right")
    for row in trial.rows:
        table.add_row(row.participant, *(f"{t.minutes:.0f} ({t.sessions})" for t in row.tested))
    return table


def as_dict(db: Session, codes: Sequence[str], caller: Caller) -> dict[str, Any]:
    """Return minutes and sessions per participant and controller, for a program."""
    return {
        row.participant: {t.controller.value: {"minutes": t.minutes, "sessions": t.sessions} for t in row.tested}
        for row in _trial(db, codes, caller).rows
    }


def _trial(db: Session, codes: Sequence[str], caller: Caller) -> TrialTime:
    return trial_time(db, [study.participant_by_code(db, code, caller) for code in codes], caller)
