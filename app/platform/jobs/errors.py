"""Errors of jobs."""

from __future__ import annotations

from app.platform.errors import BetaloopError


class JobError(BetaloopError):
    """An error in the user's words (what, where, what to do); its text is shown as it is."""


class StepFailed(JobError):
    """A step of a job failed; raised in the orchestration, with the step's message."""

    def __init__(self, key: str, message: str) -> None:
        super().__init__(f"Step {key} failed: {message}")
        self.key = key
        self.message = message


class UnknownKind(BetaloopError):
    """No job kind or compute function has this name."""

    status = 422
    title = "There is no such job kind"


class JobCancelled(BaseException):
    """Cancellation of the job by a user: unwinds the orchestration. Not an Exception, so that no `except Exception` swallows it."""


class WorkerStopping(BaseException):
    """The worker stops or lost the job: unwinds the orchestration, records nothing, and the job goes on in another worker."""
