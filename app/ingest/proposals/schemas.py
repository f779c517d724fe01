"""API types of visits that are made of a recording."""

from __future__ import annotations

from pydantic import Field

from app.ingest.schemas import ProposalOut
from app.platform.web.schemas import Int, Model
from app.study.schemas import VisitOut


class VisitOfRecordingIn(Model):
    """Which proposal, as the caller looked at it, a visit is added for."""

    version: Int = Field(ge=1)


class VisitOfRecordingOut(Model):
    """A visit on the day of a recording, and the proposals of that day, which belong to it now."""

    visit: VisitOut
    proposals: list[ProposalOut]
