"""Tables of people and access: studies and their sites are the scopes in which a member has a role."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Any

from sqlalchemy import (
    CheckConstraint,
    ForeignKey,
    Index,
    LargeBinary,
    String,
    UniqueConstraint,
    func,
    text,
)
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import Base


class Role(StrEnum):
    """Role of a member in a study. Every role but the blinded assessor includes the reading rights of `viewer`."""

    BLINDED_ASSESSOR = "blinded_assessor"
    VIEWER = "viewer"
    MONITOR = "monitor"
    COORDINATOR = "coordinator"
    CLINICIAN = "clinician"
    ENGINEER = "engineer"
    ADMIN = "admin"


class Scope(StrEnum):
    """Scope of an API token: the part of its user's rights that it has."""

    FULL = "full"
    READ = "read"
    UPLOAD = "upload"
    JOBS = "jobs"
    METRICS = "metrics"


class Study(Base):
    """A trial under one protocol.

    Codes of participants enrolled in a study with a `code_prefix` begin with it; no code of another study does. Enrolment therefore
    reveals no code of another study. The first study has no prefix. A study that has ended can be read but not changed.
    """

    __tablename__ = "study"
    __table_args__ = (Index("uq_study_code_prefix_lower", func.lower(text("code_prefix")), unique=True),)

    id: Mapped[int] = mapped_column(primary_key=True)
    code: Mapped[str] = mapped_column(String(40), unique=True)
    name: Mapped[str] = mapped_column(String(200))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    code_prefix: Mapped[str | None] = mapped_column(String(20))
    ended_at: Mapped[datetime | None]


class Site(Base):
    """A clinic that takes part in a study. One that has ended takes neither enrolments nor uploads."""

    __tablename__ = "site"
    __table_args__ = (UniqueConstraint("study_id", "code"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"))
    code: Mapped[str] = mapped_column(String(40))
    name: Mapped[str] = mapped_column(String(200))
    ended_at: Mapped[datetime | None]
    study: Mapped[Study] = relationship()


class User(Base):
    """A person who signs in."""

    __tablename__ = "app_user"
    __table_args__ = (CheckConstraint("email = lower(email)", name="email_lower"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    email: Mapped[str] = mapped_column(String(254), unique=True)
    name: Mapped[str] = mapped_column(String(200), default="")
    password_hash: Mapped[str] = mapped_column(String(300))
    active: Mapped[bool] = mapped_column(default=True)
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    memberships: Mapped[list[Membership]] = relationship(back_populates="user", cascade="all, delete-orphan")


class Membership(Base):
    """A user's role in one study, at one site of it or (site null) at all."""

    __tablename__ = "membership"
    __table_args__ = (
        UniqueConstraint("user_id", "study_id", "site_id", postgresql_nulls_not_distinct=True),
        CheckConstraint("role in ('blinded_assessor', 'viewer', 'monitor', 'coordinator', 'clinician', 'engineer', 'admin')", name="role"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    user_id: Mapped[int] = mapped_column(ForeignKey("app_user.id", ondelete="CASCADE"), index=True)
    study_id: Mapped[int] = mapped_column(ForeignKey("study.id"), index=True)
    site_id: Mapped[int | None] = mapped_column(ForeignKey("site.id"), index=True)
    role: Mapped[Role] = mapped_column(String(20))
    user: Mapped[User] = relationship(back_populates="memberships")
    study: Mapped[Study] = relationship(lazy="joined", innerjoin=True)


class SignIn(Base):
    """A browser session, kept on the server so that it can be ended; the cookie holds only its token."""

    __tablename__ = "sign_in"

    id: Mapped[int] = mapped_column(primary_key=True)
    token_sha256: Mapped[str] = mapped_column(String(64), unique=True)
    user_id: Mapped[int] = mapped_column(ForeignKey("app_user.id", ondelete="CASCADE"), index=True)
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    last_seen_at: Mapped[datetime] = mapped_column(server_default=func.now())
    ended_at: Mapped[datetime | None]
    issuer: Mapped[str | None] = mapped_column(String(500))
    """The identity provider that opened it; none where a password did."""
    confirmed_at: Mapped[datetime | None]
    """When the user last showed at the provider who they are, to sign something; taken back by the signature that used it."""
    user: Mapped[User] = relationship()


class SignOnLink(Base):
    """Identity of a user at an identity provider. It is added at the first sign-on to an existing account."""

    __tablename__ = "sign_on_link"
    __table_args__ = (UniqueConstraint("issuer", "subject"), UniqueConstraint("user_id", "issuer"))

    id: Mapped[int] = mapped_column(primary_key=True)
    user_id: Mapped[int] = mapped_column(ForeignKey("app_user.id", ondelete="CASCADE"))
    issuer: Mapped[str] = mapped_column(String(500))
    subject: Mapped[str] = mapped_column(String(255))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    last_used_at: Mapped[datetime | None]
    """When the newest login there was made that was shown here; none at or before it confirms anything."""
    user: Mapped[User] = relationship()


class SecondFactor(Base):
    """The authenticator app of a user who wants one; it counts from `confirmed_at` on."""

    __tablename__ = "second_factor"

    user_id: Mapped[int] = mapped_column(ForeignKey("app_user.id", ondelete="CASCADE"), primary_key=True, autoincrement=False)
    sealed_secret: Mapped[bytes] = mapped_column(LargeBinary)
    recovery: Mapped[list[Any]]
    """Hashes of the recovery codes that are left."""
    confirmed_at: Mapped[datetime | None]
    last_used_at: Mapped[datetime | None]
    """Begin of the time step of the last code; none at or before it works again."""


class ApiToken(Base):
    """A bearer token of a user; only its hash is kept."""

    __tablename__ = "api_token"
    __table_args__ = (
        UniqueConstraint("user_id", "name"),
        CheckConstraint("scope in ('full', 'read', 'upload', 'jobs', 'metrics')", name="scope"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    user_id: Mapped[int] = mapped_column(ForeignKey("app_user.id", ondelete="CASCADE"), index=True)
    name: Mapped[str] = mapped_column(String(100))
    scope: Mapped[Scope] = mapped_column(String(10), server_default=Scope.FULL)
    token_sha256: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    expires_at: Mapped[datetime]
    last_used_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]
    user: Mapped[User] = relationship()


class SignInAttempt(Base):
    """A try to sign in that was not right; too many of one address in a while are refused, whichever web process answers."""

    __tablename__ = "sign_in_attempt"
    __table_args__ = (Index("ix_sign_in_attempt_email_at", "email", "at"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    email: Mapped[str] = mapped_column(String(254))
    at: Mapped[datetime] = mapped_column(server_default=func.now())
    failed: Mapped[bool] = mapped_column(server_default=text("true"))
    """False while it is undecided: it was counted, and its verdict is not written yet."""
