"""API types of studies and sites."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, StringConstraints

from app.platform.web.schemas import Model, Text

HINT = "A code has 1 to 40 letters, digits, dots or hyphens; a name 1 to 200 characters."
ShortCode = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,39}$")]
Name = Annotated[Text, StringConstraints(strip_whitespace=True, min_length=1, max_length=200)]


class SiteIn(Model):
    """A site to add."""

    code: ShortCode
    name: Name


class StudyIn(SiteIn):
    """A study to add; its first site has the same code and name unless one is given."""

    site: SiteIn | None = None


class NameChange(Model):
    """Another name, and why."""

    name: Name
    reason: Text = Field(min_length=1, max_length=1000, description="Why; kept in the audit trail.")


class SiteOut(Model):
    """A site."""

    code: str
    name: str


class StudyOut(Model):
    """A study and its sites."""

    code: str
    name: str
    sites: list[SiteOut]
