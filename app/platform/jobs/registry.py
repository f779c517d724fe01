"""Which kinds of jobs there are, and which functions their child processes run."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from app.platform.jobs.errors import UnknownKind

if TYPE_CHECKING:
    from app.platform.jobs.children.report import Report
    from app.platform.jobs.context import JobContext

JOB_MODULES = (
    "app.pipeline.learning",
    "app.pipeline.evaluation",
)
"""Modules that register kinds, as names: the platform lies below the phases and may not import them. The web service imports them too."""

COMPUTE_MODULES = (
    "app.learning.training.compute",
    "app.evaluation.estimates.compute",
)
"""Modules with compute functions and their heavy imports, loaded by workers and children alone; a room may do without one."""

Orchestration = Callable[["JobContext"], dict[str, Any]]
Compute = Callable[[dict[str, Any], Path, "Report"], dict[str, Any]]

_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")


class Priority(IntEnum):
    """Who goes first in the queue; the engine lets a missing priority overtake all others, so every kind has one."""

    INTERACTIVE = 10
    NORMAL = 50
    BATCH = 90


@dataclass(frozen=True)
class Kind:
    """One kind of job."""

    name: str
    title: str
    params_schema: type[BaseModel]
    run: Orchestration
    priority: Priority


@dataclass(frozen=True)
class ComputeFunction:
    """One function for child processes; `module` is all that the child has to import."""

    name: str
    module: str
    run: Compute


_kinds: dict[str, Kind] = {}
_computes: dict[str, ComputeFunction] = {}


def job_kind(
    name: str, *, title: str, params_schema: type[BaseModel], priority: Priority = Priority.NORMAL
) -> Callable[[Orchestration], Orchestration]:
    """Register an orchestration under the name that the API calls `kind`.

    Raises:
        ValueError: a malformed name, or one that another function has.
    """
    _check_name(name)

    def register(run: Orchestration) -> Orchestration:
        _refuse_second("job kind", name, _kinds[name].run if name in _kinds else None, run)
        _kinds[name] = Kind(name, title, params_schema, run, priority)
        return run

    return register


def compute(name: str) -> Callable[[Compute], Compute]:
    """Register a function that runs in a child process.

    Raises:
        ValueError: a malformed name, or one that another function has.
    """
    _check_name(name)

    def register(run: Compute) -> Compute:
        _refuse_second("compute function", name, _computes[name].run if name in _computes else None, run)
        _computes[name] = ComputeFunction(name, run.__module__, run)
        return run

    return register


def load_kinds(modules: tuple[str, ...] | None = None) -> None:
    """Import every module that registers kinds; a missing one is an error."""
    for module in JOB_MODULES if modules is None else modules:
        import_module(module)


def kinds() -> dict[str, Kind]:
    """All kinds registered so far, by name."""
    return dict(_kinds)


def kind(name: str) -> Kind:
    """The kind of a name; the rooms are imported when it is not known yet.

    Raises:
        UnknownKind: there is none; the message lists those there are.
    """
    if name not in _kinds:
        load_kinds()
    if name not in _kinds:
        raise UnknownKind(f"There is no job kind {name!r}. Known kinds: {', '.join(sorted(_kinds)) or 'none'}.")
    return _kinds[name]


def compute_function(name: str) -> ComputeFunction:
    """The compute function of a name.

    Raises:
        UnknownKind: there is none.
    """
    if name not in _computes:
        load_kinds()
        load_kinds(tuple(module for module in COMPUTE_MODULES if find_spec(module)))
    if name not in _computes:
        raise UnknownKind(f"There is no compute function {name!r}. Known ones: {', '.join(sorted(_computes)) or 'none'}.")
    return _computes[name]


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r} cannot name a job kind or compute function: use up to 40 of a-z, 0-9 and _, beginning with a letter")


def _refuse_second(what: str, name: str, known: Callable[..., Any] | None, new: Callable[..., Any]) -> None:
    # the same function imported twice (a reload, `python -m`) is no conflict
    if known is not None and (known.__module__, known.__qualname__) != (new.__module__, new.__qualname__):
        raise ValueError(
            f"two functions register the {what} {name!r}: {known.__module__}.{known.__qualname__} and {new.__module__}.{new.__qualname__}"
        )
