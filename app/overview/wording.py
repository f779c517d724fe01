"""Sentences of the pages that join phases."""

from __future__ import annotations

from collections.abc import Callable

from app.overview.tasks import Actor, NextStep, Task
from app.overview.visit_progress import VisitProgress
from app.platform.web.charts import counted

ACTORS = {
    Actor.CLINICIAN: "Clinician",
    Actor.COORDINATOR: "Coordinator",
    Actor.ENGINEER: "Engineer",
    Actor.SERVICE: "Nobody: the service works",
}

_TASKS: dict[Task, str | Callable[[int], str]] = {
    Task.ADD_VISIT: "No visit yet",
    Task.STATE_AMPLITUDE: "No cDBS amplitude in the settings",
    Task.UPLOAD: "No session yet",
    Task.SEND_LOGS: lambda n: f"{counted(n, 'planned session')} without a log",
    Task.CONFIRM: lambda n: f"{counted(n, 'session')} to confirm",
    Task.ENTER_QOCS: lambda n: f"{counted(n, 'session')} without outcomes",
    Task.SET_THRESHOLD: "Beta threshold is not set; jobs cannot start",
    Task.WAIT_FOR_RANKING: "The first ranking is being made",
    Task.RANK: "No ranking yet: start the pipeline",
    Task.OPEN_KEY: "A blinded visit is held, and nothing learns from it: open the key of its plan",
    Task.RANK_AGAIN: "New sessions since the last ranking, which is out of date",
    Task.TRAIN_NEXT: "New sessions since the last ranking: train the next generation",
    Task.DRAFT_PLAN: "No plan for this visit yet",
    Task.APPROVE_PLAN: "A visit plan waits for approval",
    Task.LOOK_AT_FAILED: lambda n: f"{counted(n, 'job')} failed in the last 7 days",
}


def what(step: NextStep) -> str:
    """What is to be done."""
    said = _TASKS[step.task]
    return said if isinstance(said, str) else said(step.count)


def progress(visit: VisitProgress) -> str:
    """How far a visit with a signed plan is."""
    missing = f", {counted(visit.logs_missing, 'log')} missing" if visit.logs_missing else ""
    return f"Visit {visit.number}: {visit.held} of {counted(visit.planned, 'planned session')} held{missing}"


def in_days(days: int) -> str:
    """How far a day lies ahead."""
    return {0: "today", 1: "tomorrow"}.get(days, f"in {days} days")
