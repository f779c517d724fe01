"""What can go wrong in a job."""

from __future__ import annotations


class JobError(Exception):
    """An error in the user's words (what, where, how to mend it); its text is shown as it is."""


class StepFailed(JobError):
    """A step of a job failed; raised in the orchestration, with the step's message."""

    def __init__(self, key: str, message: str) -> None:
        super().__init__(f"{key}: {message}")
        self.key = key
        self.message = message


class UnknownKind(JobError):
    """No job kind or compute function has this name."""


class JobEnded(JobError):
    """The job has already ended, so that it can no longer be cancelled."""


class JobNotFound(JobError):
    """No job has this id."""


class JobCancelled(BaseException):
    """Somebody cancelled the job: unwinds the orchestration. Not an Exception, so that no `except Exception` swallows it."""


class WorkerStopping(BaseException):
    """The worker stops: unwinds the orchestration without recording anything, so that the job goes on in another worker."""
