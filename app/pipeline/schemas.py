"""API types of jobs of every kind: what starts one derives from the registered kinds."""

from __future__ import annotations

from datetime import datetime
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, Field, create_model

from app.platform.jobs import registry
from app.platform.web.schemas import Model


def _start_of(kind: registry.JobKind) -> type[BaseModel]:
    """Build the model of the kind's params and name, which is the body of `POST .../jobs`."""
    name = f"{kind.name.title().replace('_', '')}Job"
    again = Field(False, description="Whether to start another one although the same waits or runs.")
    bulk = Field(False, description="Whether no person waits for it: it begins after all other jobs, as of a night or a sweep.")
    own: dict[str, Any] = {"kind": (Literal[kind.name], ...), "again": (bool, again), "bulk": (bool, bulk)}
    return create_model(name, __base__=kind.params, __doc__=f"{kind.title}.", **own)


if TYPE_CHECKING:
    JobIn = Any
else:
    JobIn = Annotated[reduce(or_, map(_start_of, registry.kinds().values())), Field(discriminator="kind")]
    """What starts a job: one of the kinds that were registered when this module was imported."""


class JobStepOut(Model):
    """One step of a job."""

    key: str
    title: str
    status: str
    progress: float
    message: str
    attempts: int
    started_at: datetime | None
    finished_at: datetime | None


class JobOut(Model):
    """A job."""

    id: str
    kind: str
    participant: str | None
    status: str
    progress: float
    seconds_left: float | None
    message: str
    params: dict[str, Any]
    result: dict[str, Any] | None
    error: str | None
    code_version: str
    created_at: datetime
    created_by: str
    started_at: datetime | None
    finished_at: datetime | None
    cancel_requested_at: datetime | None
    steps: list[JobStepOut]
