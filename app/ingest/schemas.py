"""API types of uploads."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from app.platform.schemas import Int, Model, Moment, Text
from app.study.models import Controller, Hemisphere
from app.study.schemas import SessionOut


class UploadForm(Model):
    """What the upload page asks about the session that a file holds."""

    visit: Int = Field(ge=1)
    controller: Controller
    policy: Text | None = Field(None, max_length=100)
    started_at: Moment | None = None
    hemisphere: Hemisphere | None = None


class ProblemOut(Model):
    """Why a file could not be used."""

    what: str
    where: str
    mend: str


class FileReportOut(Model):
    """What became of one file; every list holds sentences for the person who uploaded it."""

    name: str
    understood: list[str]
    repaired: list[str]
    ignored: list[str]
    flagged: list[str]
    removed: list[str]
    problem: ProblemOut | None


class UploadedFileOut(Model):
    """One file of an upload."""

    name: str
    kind: str
    size: int
    sha256: str
    stored_sha256: str | None
    status: str
    duplicate: bool
    session_ids: list[int]


class UploadOut(Model):
    """Answer of an upload: its files (`sha256` and `duplicate` are the first file's), the sessions they belong to, a report per file."""

    id: int
    sha256: str
    duplicate: bool
    participant: str
    status: str
    created_at: datetime
    created_by: str
    sessions: list[SessionOut]
    files: list[UploadedFileOut]
    report: list[FileReportOut]
