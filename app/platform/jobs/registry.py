"""Registry of the kinds of jobs, and of the functions that their child processes run.

A kind is one record. It names what it runs by strings, `module:function`. The process that runs it imports it: workers the orchestration,
children the compute functions. So the web service knows every kind and loads none of the learners.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel
from sqlalchemy.orm import Session

from app.platform.jobs.context import UnknownKind

if TYPE_CHECKING:
    from app.platform.jobs.children.report import StepReport
    from app.platform.jobs.context import JobContext

KIND_MODULES = ("app.pipeline.kinds",)
"""Modules that register kinds, as names: the platform is below the phases and may not import them."""

Orchestration = Callable[["JobContext"], dict[str, Any]]
ComputeFunction = Callable[[dict[str, Any], Path, "StepReport"], dict[str, Any]]
Requirement = Callable[[Session, int, Any], object]
"""Called with the participant's id and the checked params before a job is put on the queue; raises what the user must correct first."""

_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
_REFERENCE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


class Priority(IntEnum):
    """Priority in the queue: a person waits for interactive jobs, and for no batch. The engine wants one of every job."""

    INTERACTIVE = 10
    NORMAL = 50
    BATCH = 90


@dataclass(frozen=True, kw_only=True)
class JobKind:
    """One kind of job.

    Attributes:
        name: what the API calls `kind`; stored with every job.
        title: what people read.
        params: schema of what may be asked for.
        orchestration: `module:function` that takes a `JobContext` and returns the job's result.
        compute: `module:function` by the names under which the orchestration calls for compute functions. A name belongs to one function,
            whichever kinds use it.
        requires: what must exist before such a job may start.
        priority: in the queue.
        one_at_a_time: whether a participant has one such job at once: who asks again before it has ended is given that one.

    Raises:
        ValueError: a malformed name or reference.
    """

    name: str
    title: str
    params: type[BaseModel]
    orchestration: str
    compute: Mapping[str, str] = field(default_factory=dict)
    requires: tuple[Requirement, ...] = ()
    priority: Priority = Priority.NORMAL
    one_at_a_time: bool = False

    def __post_init__(self) -> None:
        for name in (self.name, *self.compute):
            if not _NAME.fullmatch(name):
                raise ValueError(
                    f"{name!r} cannot name a job kind or compute function: use up to 40 of a-z, 0-9 and _, beginning with a letter"
                )
        for reference in (self.orchestration, *self.compute.values()):
            if not _REFERENCE.fullmatch(reference):
                raise ValueError(f"{reference!r} in job kind {self.name!r} names no function: write module:function")

    @property
    def needs(self) -> list[str]:
        """Params without a default: such a job is started where they are known, not from the form for all kinds."""
        return [name for name, field in self.params.model_fields.items() if field.is_required()]

    def run(self, job: JobContext) -> dict[str, Any]:
        """Import the orchestration and run it."""
        orchestration: Orchestration = _load(self.orchestration)
        return orchestration(job)


_kinds: dict[str, JobKind] = {}


def register(kind: JobKind) -> JobKind:
    """Make a kind known.

    Raises:
        ValueError: another kind has its name, or another function the name of one of its compute functions.
    """
    known = _kinds.get(kind.name)
    if known is not None and known.orchestration != kind.orchestration:
        raise ValueError(f"two orchestrations register the job kind {kind.name!r}: {known.orchestration} and {kind.orchestration}")
    for name, reference in kind.compute.items():
        others = {other.compute[name] for other in _kinds.values() if name in other.compute} - {reference}
        if others:
            raise ValueError(f"two functions register the compute function {name!r}: {others.pop()} and {reference}")
    _kinds[kind.name] = kind
    return kind


def load_kinds() -> None:
    """Import every module that registers kinds; a missing one is an error."""
    for module in KIND_MODULES:
        import_module(module)


def kinds() -> dict[str, JobKind]:
    """Return all kinds, by name, in the order of registration."""
    load_kinds()
    return dict(_kinds)


def kind(name: str) -> JobKind:
    """Find a kind by its name.

    Raises:
        UnknownKind: there is none; the message lists those there are.
    """
    if name not in _kinds:
        load_kinds()
    if name not in _kinds:
        raise UnknownKind(f"There is no job kind {name!r}. Known kinds: {', '.join(sorted(_kinds)) or 'none'}.")
    return _kinds[name]


def compute_reference(name: str) -> str:
    """Return the place of a compute function, as `module:function`; nothing of it is imported.

    Raises:
        UnknownKind: no kind has such a function.
    """
    if name not in (known := _compute_references()):
        load_kinds()
        known = _compute_references()
    if name not in known:
        raise UnknownKind(f"There is no compute function {name!r}. Known ones: {', '.join(sorted(known)) or 'none'}.")
    return known[name]


def _compute_references() -> dict[str, str]:
    return {name: reference for kind in _kinds.values() for name, reference in kind.compute.items()}


def load_compute(reference: str) -> ComputeFunction:
    """Import a compute function; for the child process that runs it."""
    function: ComputeFunction = _load(reference)
    return function


def _load(reference: str) -> Any:
    module, _, name = reference.partition(":")
    return getattr(import_module(module), name)
