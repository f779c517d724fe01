"""Tools of an orchestration: steps, compute, fan-out, transactions."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from app.platform.errors import BetaloopError

if TYPE_CHECKING:
    from sqlalchemy.orm import Session


# Errors of jobs.


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


_KEY = re.compile(r"[a-z0-9][a-z0-9_.\-]*(/[a-z0-9][a-z0-9_.\-]*)*")
_KEY_LENGTH = 100

StepOutcome = dict[str, Any]
"""`{"ok": True, "result": {...}}`, `{"ok": False, "message": "..."}` or, never started, `{"ok": False, "skipped": True}`. The
child's error is also stored as `cause`, a `Cause` of `children.child`."""


class Steps(Protocol):
    """Carries out the steps of one job and keeps their records; a step that has ended gives its recorded outcome."""

    def declare(self, key: str, title: str, weight: float) -> None:
        """Make the step's row unless it is there."""

    def compute(self, key: str, name: str, params: dict[str, Any], skip: Callable[[], bool]) -> StepOutcome:
        """Run a compute function in a child process, unless `skip()` holds when its turn comes."""

    def transact(self, key: str, fn: Callable[[Session], dict[str, Any]]) -> StepOutcome:
        """Run a function in a database transaction together with its record."""

    def workdir(self, key: str) -> Path:
        """Return the folder of a step."""


class JobContext:
    """One job, seen from its orchestration.

    Attributes:
        id: the job's id, a UUID.
        kind: its registered name.
        participant_id: whose job it is, or None.
        params: what was submitted, checked by the kind's schema, as JSON.
        created_by: who submitted it.
    """

    def __init__(self, id: str, kind: str, participant_id: int | None, params: dict[str, Any], created_by: str, steps: Steps) -> None:
        self.id = id
        self.kind = kind
        self.participant_id = participant_id
        self.params = params
        self.created_by = created_by
        self._steps = steps
        self._used: set[str] = set()

    def step(self, key: str, title: str | None = None, *, weight: float = 1.0) -> None:
        """Declare a step before it runs, so that progress counts it from the start; steps show in the order of declaration.

        Args:
            key: identity of the step, as in `train/2`.
            title: what the user reads; the key by default.
            weight: its share of the job's progress, for instance its expected minutes.

        Raises:
            ValueError: a malformed key or a weight that is not positive.
        """
        if not _KEY.fullmatch(key) or len(key) > _KEY_LENGTH:
            raise ValueError(f"{key!r} cannot be a step's key: use up to {_KEY_LENGTH} of a-z 0-9 _ . - in parts divided by /")
        if not weight > 0:
            raise ValueError(f"the weight of step {key!r} must be positive, not {weight}")
        self._steps.declare(key, title or key, weight)

    def compute(self, key: str, name: str, params: dict[str, Any]) -> dict[str, Any]:
        """Run the compute function `name` in a child process and return its result.

        Raises:
            StepFailed: the function raised, ran out of memory or was killed.
        """
        return self.compute_all([(key, name, params)])[0]

    def compute_all(self, calls: Sequence[tuple[str, str, dict[str, Any]]]) -> list[dict[str, Any]]:
        """Run several `(key, name, params)` side by side, as many as the worker has slots; results in the order given.

        When one fails, those already running finish (their results are kept) and those still waiting do not start.

        Raises:
            StepFailed: of the first that failed, in the order given.
        """
        for key, _, _ in calls:
            self._use(key)
        failed: list[str] = []

        def run(call: tuple[str, str, dict[str, Any]]) -> StepOutcome:
            outcome = self._steps.compute(*call, lambda: bool(failed))
            if not outcome["ok"]:
                failed.append(call[0])
            return outcome

        if not calls:
            return []
        with ThreadPoolExecutor(max_workers=len(calls), thread_name_prefix="fan-out") as pool:
            # a step that raises (cancel, stop) does not keep the others from ending: the pool waits for all
            futures = [pool.submit(run, call) for call in calls]
        outcomes = [future.result() for future in futures]
        for (key, _, _), outcome in zip(calls, outcomes, strict=True):
            if not outcome["ok"] and not outcome.get("skipped"):
                raise StepFailed(key, outcome["message"])
        return [outcome["result"] for outcome in outcomes]

    def transact(self, key: str, fn: Callable[[Session], dict[str, Any]]) -> dict[str, Any]:
        """Run `fn(db)` and record its JSON result in the same transaction: exactly once, whatever crashes.

        The session acts as the person who submitted the job; `fn` does not commit.

        Raises:
            StepFailed: `fn` raised; nothing that it wrote remains.
        """
        self._use(key)
        outcome = self._steps.transact(key, fn)
        if not outcome["ok"]:
            raise StepFailed(key, outcome["message"])
        result: dict[str, Any] = outcome["result"]
        return result

    def workdir(self, key: str) -> Path:
        """Return the folder of a compute step, for files that its function left there."""
        return self._steps.workdir(key)

    def _use(self, key: str) -> None:
        if key in self._used:
            raise ValueError(f"step {key!r} of job kind {self.kind!r} is run twice: every run needs a key of its own")
        self._used.add(key)
        self.step(key)
