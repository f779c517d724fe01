"""API types of taking part."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from app.platform.web.schemas import Model, Text

Status = Literal["active", "completed", "withdrawn"]


class StatusChange(Model):
    """Whether a participant takes part, and why that changes."""

    status: Status
    reason: Text = Field(min_length=1, max_length=1000, description="Why; kept in the audit trail.")
