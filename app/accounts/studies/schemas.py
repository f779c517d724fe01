"""API types of studies, sites and memberships."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import Field, StringConstraints

from app.platform.web.schemas import Model, Text
from app.tables.accounts import Role

HINT = (
    "A code has 1 to 40 letters, digits, dots or hyphens; a name 1 to 200 characters; "
    "a prefix 1 to 20 letters, digits, hyphens or underscores, the first a letter or digit."
)
ShortCode = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,39}$")]
Name = Annotated[Text, StringConstraints(strip_whitespace=True, min_length=1, max_length=200)]
Prefix = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,19}$")]
Reason = Annotated[Text, StringConstraints(strip_whitespace=True, min_length=1, max_length=1000)]


class SiteIn(Model):
    """A site to add."""

    code: ShortCode
    name: Name


class StudyIn(SiteIn):
    """A study to add; its first site has the same code and name unless one is given."""

    site: SiteIn | None = None
    code_prefix: Prefix | None = Field(
        None, description="What every code of its participants begins with; the study's code and a hyphen when left out."
    )


class StudyChange(Model):
    """Another name, or the prefix that a study lacks, and why."""

    name: Name | None = None
    code_prefix: Prefix | None = Field(None, description="Of a study that has none: what codes begin with from now on.")
    reason: Reason = Field(description="Why; kept in the audit trail.")


class NameChange(Model):
    """Another name, and why."""

    name: Name
    reason: Text = Field(min_length=1, max_length=1000, description="Why; kept in the audit trail.")


class EndingReason(Model):
    """Reason why a study or a site ends, or is opened again."""

    reason: Reason = Field(description="Kept in the audit trail.")


class SiteOut(Model):
    """A site. One that has ended takes neither enrolments nor uploads."""

    code: str
    name: str
    ended_at: datetime | None


class StudyOut(Model):
    """A study and its sites. One that has ended is read, and nothing in it changes."""

    code: str
    name: str
    code_prefix: str | None = Field(description="What every code of its participants begins with; null for the first study.")
    ended_at: datetime | None
    sites: list[SiteOut]


class Member(Model):
    """Member of a study: a user with a role, at a site or at all sites."""

    email: Text = Field(max_length=254, description="E-mail address of the user.")
    site: ShortCode | None = Field(None, description="Code of the site; null is all sites.")


class MemberIn(Member):
    """A role to give. It replaces the role that the user has there, and a role at one site also one at all sites."""

    role: Role
    also: bool = Field(False, description="Keep a role at all sites besides this one at a single site.")


class MemberOut(Model):
    """A user's role in a study."""

    email: str
    role: Role
    site: str | None = Field(description="Code of the site; null is all sites.")
    active: bool = Field(description="Whether the account is open.")
