"""API types of uploads."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from app.platform.web.schemas import Int, Model, Moment, Number, Text
from app.study.recordings.amplitude_sources import AmplitudeChoice, AmplitudeConflictOut
from app.study.schemas import SessionOut, VisitOut
from app.tables.participants import Hemisphere
from app.tables.sessions import Controller


class UploadForm(Model):
    """Statements of the upload page about the sessions in the files; empty ones are proposed from the files."""

    visit: Int | None = Field(None, ge=1)
    controller: Controller | None = None
    policy: Text | None = Field(None, max_length=100)
    started_at: Moment | None = None
    hemisphere: Hemisphere | None = None


class ProposalChange(Model):
    """Corrections of a proposed session; omitted ones stay. `version` is that of the proposal the caller looked at."""

    version: Int = Field(ge=1)
    visit: Int | None = Field(None, ge=1, description="Number of the visit.")
    controller: Controller | None = Field(None, description="What drove the stimulation; null leaves it open.")
    policy: Text | None = Field(None, max_length=100, description="Name or number of the policy that ran.")
    hemisphere: Hemisphere | None = Field(None, description="Side of the controlled implant.")
    control_stream: Text | None = Field(None, max_length=40, description="Stream of the channel that the controller saw.")
    control_channel: Text | None = Field(None, max_length=80, description="The channel that the controller saw.")
    control_program: Int | None = Field(None, ge=0, le=15, description="Program whose amplitude the controller set.")
    start_s: Number | None = Field(None, ge=0, le=1e7, description="Where the session begins in its control recording, s.")
    stop_s: Number | None = Field(None, ge=0, le=1e7, description="Where it ends in its control recording, s.")
    started_at: Moment | None = Field(None, description="Start, date and time of day; moves the begin where the recording has a clock.")
    reason: Text | None = Field(None, max_length=1000, description="Kept in the audit trail.")


class PartIn(Model):
    """A part of a recording that is a session of its own."""

    start_s: Number = Field(ge=0, le=1e7, description="Begin in the control recording, s.")
    stop_s: Number = Field(gt=0, le=1e7, description="End in the control recording, s.")
    controller: Controller | None = None


class SplitIn(Model):
    """Parts that take the place of one proposal."""

    version: Int = Field(ge=1)
    parts: list[PartIn] = Field(min_length=1, max_length=50)


class DiscardIn(Model):
    """Reason why a proposal is no session."""

    version: Int = Field(ge=1)
    reason: Text = Field(min_length=1, max_length=1000)


class PartOut(Model):
    """The part of one recording that a session has."""

    recording_id: int
    hemisphere: Hemisphere | None
    recording_started_at: datetime | None
    recording_s: float = Field(description="Length of the whole recording, s.")
    start_s: float
    stop_s: float
    is_control: bool


class UsableStepsOut(Model):
    """Steps of one channel that can be learned from."""

    stream: str
    channel: str
    source: str
    is_control: bool = Field(description="The controller is taken to have seen this channel.")
    steps: int = Field(description="Steps of the session.")
    valid: int = Field(description="Steps with a valid beta.")
    usable: int = Field(description="Steps that may enter a replay buffer.")
    reason: str | None = Field(description="Why there are none; null where there are some.")
    late_s: float = Field(description="Seconds of the session before its first whole state, as beta begins too late; 0 where none.")


class ProposalOut(Model):
    """A proposed session, and why it is proposed so."""

    session: SessionOut
    version: int
    upload_id: int
    visit_open: bool = Field(description="The visit is only a place to keep the proposal in; a person must choose one.")
    evidence: dict[str, str] = Field(description="By field, why it is proposed so.")
    changed_by: str
    parts: list[PartOut]
    usable_steps: list[UsableStepsOut] = Field(description="By channel of the control recording, the control channel first.")
    amplitude_conflicts: list[AmplitudeConflictOut] = Field(description="Where sources of the amplitude differ: one must be chosen.")
    clock_unknown: bool = Field(description="Whether the start is on a clock of unknown offset from UTC.")
    usable_on_any: int = Field(description="Steps that are usable on one time-domain channel or another, each counted once.")


class AmplitudeChoiceIn(AmplitudeChoice):
    """Choice among the sources of the amplitude of a proposed session."""

    version: Int = Field(ge=1, description="Of the proposal, as it was read.")


class ConfirmedOut(Model):
    """A session that counts from now on, and what should be looked at."""

    session: SessionOut
    notes: list[str]


class AttachIn(Model):
    """The session that a file without a clock belongs to."""

    session_id: Int = Field(ge=1)


class AttachedOut(Model):
    """Result of attaching a file."""

    session: SessionOut
    notes: list[str]


class QuarantinedOut(Model):
    """A file that is, or was, kept encrypted because it could not all be read."""

    id: int
    upload_id: int
    kind: str
    size: int
    sha256: str
    status: str
    held: bool = Field(description="Whether the encrypted original is still there.")
    problem: str
    reviewed_by: str | None
    reviewed_at: datetime | None
    decided_by: str | None
    decided_at: datetime | None
    decision_reason: str | None


class ReleaseIn(Model):
    """Release of a quarantined file: `read` hands it to the present decoder, `as_is` stores it, reviewed, as it came."""

    how: Literal["read", "as_is"]
    reason: Text = Field(min_length=1, max_length=1000)


class QuarantineDiscardIn(Model):
    """Reason why a quarantined file is erased."""

    reason: Text = Field(min_length=1, max_length=1000)


class ProblemOut(Model):
    """Reason why a file could not be used."""

    what: str
    where: str
    hint: str


class FileReportOut(Model):
    """Report on one file; every list contains sentences for the person who uploaded it."""

    name: str
    understood: list[str]
    repaired: list[str]
    ignored: list[str]
    flagged: list[str]
    removed: list[str]
    problem: ProblemOut | None


class UploadedFileOut(Model):
    """One file of an upload: hashes of the original (`sha256`) and of what is kept, without identity (`stored_sha256`)."""

    id: int
    name: str
    kind: str
    size: int
    sha256: str
    stored_sha256: str | None
    redactor_version: int | None
    quarantined: bool = Field(description="Whether the original is kept, encrypted, because it could not all be read.")
    status: str
    waits_for_mapping: bool = Field(description="Whether it is a table that can be read once its columns are named.")
    duplicate: bool
    session_ids: list[int]


class UploadOut(Model):
    """Answer of an upload: its files (`sha256` is the first file's), the sessions they belong to, a report per file."""

    id: int
    sha256: str | None = Field(description="Null where no file was kept.")
    duplicate: bool = Field(description="Whether all files, or all of their recordings, had come before.")
    participant: str
    status: str
    created_at: datetime
    created_by: str
    sessions: list[SessionOut] = Field(description="Sessions of the files; those of status 'proposed' count only once confirmed.")
    proposals: list[ProposalOut]
    files: list[UploadedFileOut]
    report: list[FileReportOut]


class VisitOfRecordingIn(Model):
    """Proposal, as the caller looked at it, that a visit is added for."""

    version: Int = Field(ge=1)


class VisitOfRecordingOut(Model):
    """A visit on the day of a recording, and the proposals of that day, which belong to it now."""

    visit: VisitOut
    proposals: list[ProposalOut]
