"""API types of a session's recordings."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from app.platform.web.schemas import Model
from app.study.models import Hemisphere


class RecordedTraceOut(Model):
    """One trace of one recording of a session, on its own rows; null where a row is invalid."""

    id: int
    recording_id: int
    hemisphere: Hemisphere | None
    stream: str
    channel: str
    unit: str
    source: str
    decode_version: int
    is_control: bool = Field(description="The trace that the controller is taken to have seen.")
    details: dict[str, Any] = Field(description="How the values were made.")
    t_s: list[float] = Field(description="End of each row, s from the session's start; rows with t_s <= 0 lie before it.")
    values: list[float | None]
