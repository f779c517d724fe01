"""API types of previews and column mappings."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from app.ingest.schemas import FileReportOut
from app.platform.web.schemas import Int, Model, Number, Text
from app.tables.participants import Hemisphere
from ml.formats.tables.mapping.model import Holds, TimeFormat

Role = Literal[
    "time",
    "beta",
    "beta_power",
    "lfp",
    "amplitude_ma",
    "amplitude_fraction",
    "tremor_unknown",
    "tremor_none",
    "tremor_slight",
    "tremor_mild",
    "tremor_moderate",
    "tremor_strong",
    "tremor_class",
    "hand",
]


class MappedColumnIn(Model):
    """Role of one column; omitted columns are removed from the table before it is stored."""

    number: Int = Field(ge=1, le=64, description="Of the column, from 1.")
    role: Role
    unit: Text | None = Field(None, max_length=20, description="Of beta, LFP and amplitudes, which must state one.")
    side: Hemisphere | None = Field(None, description="Of the signal or amplitude, where the table has both or it is known.")
    channel: Text | None = Field(None, max_length=20, description="Contacts, such as 0-2; needed where a side has several signals.")


class MappingIn(Model):
    """Reading of tables in a study that have the header of a waiting table."""

    name: Text = Field(min_length=1, max_length=100, description="What such tables are called in the study.")
    header_line: Int = Field(ge=1, le=21, description="Line that names the columns; lines above it are titles.")
    unit_lines: Int = Field(0, ge=0, le=3, description="Lines right below it that are no rows.")
    holds: Holds = Field(description="Steps of beta, samples of LFP, minutes of tremor, or times of open fists.")
    time_format: TimeFormat = Field(description="From the session's start, Unix time, or dates: year, day or month first.")
    zone: Text | None = Field(None, max_length=60, description="IANA name of the zone of written dates, e.g. Europe/Berlin or UTC.")
    rate_hz: Number | None = Field(None, gt=0, le=1e5, description="Samples a second, where times are numbers of samples.")
    time_at: Literal["begin", "end"] | None = Field(None, description="Whether the time of a step is that of its begin or its end.")
    columns: list[MappedColumnIn] = Field(min_length=1, max_length=64)
    reason: Text | None = Field(None, max_length=1000, description="Kept with the version and in the audit trail.")


class RemovalIn(Model):
    """Reason why a mapping is removed."""

    reason: Text = Field(min_length=1, max_length=1000)


class PreviewLineOut(Model):
    """One of the first lines of a table, screened for identity."""

    number: int
    cells: list[str] = Field(description="Words of the field and measurements as they are, other words as …, other digits as #.")
    may_be_header: bool


class MappingOut(Model):
    """A version of a column mapping of a study."""

    id: int
    name: str
    version: int
    current: bool = Field(description="Whether tables are read by it now.")
    removed: bool = Field(description="Whether this version ended the mapping.")
    unit_lines: int
    holds: Holds
    time_format: TimeFormat
    zone: str | None
    rate_hz: float | None
    time_at: Literal["begin", "end"] | None
    columns: list[MappedColumnIn]
    labels: dict[str, str] = Field(description="By column number, what the preview showed of its name.")
    created_at: datetime
    created_by: str
    reason: str | None


class PreviewOut(Model):
    """A table that waits for a column mapping: what may be shown of it, and why it could not be read."""

    file_id: int
    participant: str
    problem: str
    width: int = Field(description="Columns of the table.")
    lines: list[PreviewLineOut]
    header_line: int = Field(description="The line that looks like the one of names.")
    unit_lines: int = Field(description="Lines below it that look like units.")
    mapping: MappingOut | None = Field(description="The study's mapping for this header, which did not read the table.")


class MappedOut(Model):
    """A mapping that was stored, and what came of the tables that waited for it."""

    mapping: MappingOut
    report: list[FileReportOut]
    session_ids: list[int]
    waiting: list[int] = Field(description="Files of the same upload and header that this mapping does not read.")
