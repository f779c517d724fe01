"""Tables of visit plans, of the bundles taken for them, and of what was entered on the clinic day."""

from __future__ import annotations

import uuid
from datetime import datetime, time
from typing import Any

import sqlalchemy as sa
from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    ForeignKey,
    Index,
    SmallInteger,
    String,
    Text,
    UniqueConstraint,
    Uuid,
    and_,
    func,
)
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import Mapped, column_property, mapped_column, relationship

from app.platform.database import Base
from app.tables.participants import HEMISPHERE_CHECK, Hemisphere
from app.tables.sessions import Controller, StudySession
from app.tables.visits import Visit


class Plan(Base):
    """Plan of a visit: drafted from a ranking, approved by a clinician, then fixed."""

    __tablename__ = "plan"
    __table_args__ = (
        CheckConstraint("status in ('draft', 'approved', 'superseded')", name="status"),
        CheckConstraint("(status = 'draft') = (approved_at is null) or status = 'superseded'", name="approval"),
        CheckConstraint("(key_opened_at is null) = (key_opened_by is null)", name="key_opened"),
        CheckConstraint("key_opened_at is null or key_opened_in_emergency or key_opened_reason is not null", name="key_reason"),
        Index("uq_plan_visit_live", "visit_id", unique=True, postgresql_where="status <> 'superseded'"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    visit_id: Mapped[int] = mapped_column(ForeignKey("visit.id"), index=True)
    evaluation_id: Mapped[int | None] = mapped_column(ForeignKey("evaluation.id"))
    status: Mapped[str] = mapped_column(String(20), server_default="draft")
    seed: Mapped[int]
    rules: Mapped[dict[str, Any]]
    note: Mapped[str] = mapped_column(Text, server_default="")
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))
    approved_at: Mapped[datetime | None]
    approved_by: Mapped[str | None] = mapped_column(String(254))
    starts_at: Mapped[time | None]
    """Time of day of the first session, by the clinic's clock; None where only minutes from it are planned."""
    blinded: Mapped[bool] = mapped_column(server_default="false")
    """Whether the visit runs under labels. Which label is which policy is the sealed key, until it is opened."""
    key_opened_at: Mapped[datetime | None]
    key_opened_by: Mapped[str | None] = mapped_column(String(254))
    key_opened_reason: Mapped[str | None] = mapped_column(Text)
    """Why it was opened; in an emergency it may be given afterwards."""
    key_opened_in_emergency: Mapped[bool] = mapped_column(server_default="false")
    items: Mapped[list[PlanItem]] = relationship(order_by="PlanItem.position", cascade="all, delete-orphan")


SEALED = and_(Plan.blinded, Plan.approved_at.is_not(None), Plan.key_opened_at.is_(None))
"""Condition on `Plan`: as `app.planning.plans.sign_off.sealed`, of replaced plans too."""


class PlanItem(Base):
    """One session of a plan: the slot of the visit that a recording fills (`StudySession.plan_item_id`).

    `min_ma`, `max_ma` and `ramp_ma_per_s` are the session's limits, set before the plan is signed. They are null in plans of earlier
    versions, and where the cDBS amplitude is not known. `repeat` counts the sessions of one policy (or of cDBS and so on) within the visit,
    from 1. `label` is what a blinded visit calls it.
    """

    __tablename__ = "plan_item"
    __table_args__ = (
        UniqueConstraint("plan_id", "position"),
        CheckConstraint("minutes > 0 and washout_minutes >= 0", name="minutes"),
        CheckConstraint("controller in ('cdbs', 'rl', 'distilled', 'no_dbs', 'random', 'other')", name="controller"),
        CheckConstraint("min_fraction > 0 and min_fraction <= 1", name="min_fraction"),
        CheckConstraint(HEMISPHERE_CHECK, name="hemisphere"),
        CheckConstraint("min_ma >= 0 and min_ma <= max_ma and ramp_ma_per_s > 0 and cdbs_ma > 0", name="limits"),
        CheckConstraint('"repeat" >= 1', name="repeat"),
        CheckConstraint("break_minutes >= 0", name="break_minutes"),
        CheckConstraint("override_reason is null or override_reason <> ''", name="override_reason"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    plan_id: Mapped[int] = mapped_column(ForeignKey("plan.id", ondelete="CASCADE"))
    position: Mapped[int]
    controller: Mapped[Controller] = mapped_column(String(20))
    policy_id: Mapped[int | None] = mapped_column(ForeignKey("policy.id"))
    minutes: Mapped[float]
    washout_minutes: Mapped[float]
    note: Mapped[str] = mapped_column(Text, server_default="")
    hemisphere: Mapped[Hemisphere | None] = mapped_column(String(5))
    """Side whose amplitude the controller sets; None where the cDBS amplitude is stated without one."""
    cdbs_ma: Mapped[float | None]
    """The clinical amplitude that the limits were set for, and to which every fault leads back."""
    min_ma: Mapped[float | None]
    max_ma: Mapped[float | None]
    ramp_ma_per_s: Mapped[float | None]
    repeat: Mapped[int] = mapped_column(SmallInteger, server_default="1")
    label: Mapped[str | None] = mapped_column(String(10))
    break_minutes: Mapped[float] = mapped_column(server_default="0")
    """Rest after the session's washout, minutes."""
    medication: Mapped[str] = mapped_column(Text, server_default="")
    """What is due before the session."""
    verdict: Mapped[str | None] = mapped_column(String(20))
    """Verdict on the policy when the plan was drafted: the stricter of the plan's ranking and the newest one. `unsafe` after a serious
    adverse event, ranked or not."""
    min_fraction: Mapped[float | None]
    """Lowest amplitude of the session's envelope, fraction of the cDBS amplitude; None where the plan states none."""
    override_reason: Mapped[str | None] = mapped_column(Text)
    """Why a clinician plans an unsafe policy all the same."""
    design: Mapped[dict[str, Any] | None] = mapped_column(JSONB(none_as_null=True))
    """Design of a random session, or of one kept near an amplitude: `app.planning.plans.designs.Planned.as_json`. Null for other
    controllers and in older plans."""


class BundleRelease(Base):
    """A controller bundle that left the service: who took which policy within which limits, and with whose approval. Insert only.

    `policy_id` is null where the session's amplitudes were laid out beforehand, `plan_item_id` where the bundle is for no planned session.
    `approvals` holds the sign-offs of the manifest; null for bundles taken before they were recorded here. `content_sha256` is the hash of
    the content without who took it first and when. Equal content is given out as the same bytes. Null for bundles of earlier versions.
    """

    __tablename__ = "bundle_release"
    __table_args__ = (
        CheckConstraint("hemisphere in ('left', 'right')", name="hemisphere"),
        CheckConstraint("policy_id is not null or plan_item_id is not null", name="what"),
        CheckConstraint("min_ma >= 0 and min_ma <= cdbs_ma and cdbs_ma <= max_ma and ramp_ma_per_s > 0", name="limits"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"), index=True)
    policy_id: Mapped[int | None] = mapped_column(ForeignKey("policy.id"), index=True)
    plan_item_id: Mapped[int | None] = mapped_column(ForeignKey("plan_item.id"), index=True)
    sha256: Mapped[str] = mapped_column(ForeignKey("stored_file.sha256"))
    content_sha256: Mapped[str | None] = mapped_column(String(64), index=True)
    hemisphere: Mapped[Hemisphere | None] = mapped_column(String(10))
    min_ma: Mapped[float]
    max_ma: Mapped[float]
    cdbs_ma: Mapped[float]
    ramp_ma_per_s: Mapped[float]
    approvals: Mapped[list[dict[str, Any]] | None] = mapped_column(JSONB(none_as_null=True))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))


class PortCheck(Base):
    """Check of a converted copy of a policy against a bundle, by the answers that it gave (`ml.deploy.ports`). Insert only.

    `bundle_sha256` is the bundle whose vectors were answered, `answers_sha256` the table of answers. `target` is what was converted, by
    what. `result` is `ml.deploy.ports.check.PortCheck` as JSON.
    """

    __tablename__ = "port_check"
    __table_args__ = (
        CheckConstraint("verdict in ('same', 'within', 'not this policy')", name="verdict"),
        CheckConstraint("target <> ''", name="target"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    policy_id: Mapped[int] = mapped_column(ForeignKey("policy.id"), index=True)
    bundle_sha256: Mapped[str] = mapped_column(ForeignKey("stored_file.sha256"))
    answers_sha256: Mapped[str] = mapped_column(ForeignKey("stored_file.sha256"))
    target: Mapped[str] = mapped_column(String(100))
    verdict: Mapped[str] = mapped_column(String(20))
    result: Mapped[dict[str, Any]] = mapped_column(JSONB(none_as_null=True))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    created_by: Mapped[str] = mapped_column(String(254))


KINDS = (
    "start", "stop", "stop_cause", "rating", "grasp", "dyskinesia", "speech", "gait", "note", "adverse_event", "skip", "repeat",
    "session_end", "clinical_settings", "dose",
)  # fmt: skip

OF_THE_DAY = ("note", "adverse_event", "clinical_settings", "dose")
"""Kinds that may belong to the day as a whole; all others belong to one session of the plan."""


class DayEntry(Base):
    """Entry of the clinic day. Insert only; a correction is a new entry that names what it replaces.

    `device_time` is the time of the tablet's clock. Adding `clock_offset_ms`, as last measured by the tablet, gives the service's time;
    it is null if the tablet had not reached the service yet.
    """

    __tablename__ = "day_entry"
    __table_args__ = (
        CheckConstraint(f"kind in ({', '.join(repr(k) for k in KINDS)})", name="kind"),
        CheckConstraint("(plan_item_id is null) = (attempt is null) and attempt >= 1", name="attempt"),
        CheckConstraint(f"plan_item_id is not null or kind in ({', '.join(repr(k) for k in OF_THE_DAY)})", name="session"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    uuid: Mapped[uuid.UUID] = mapped_column(Uuid, unique=True)
    plan_id: Mapped[int] = mapped_column(ForeignKey("plan.id"), index=True)
    plan_item_id: Mapped[int | None] = mapped_column(ForeignKey("plan_item.id"), index=True)
    attempt: Mapped[int | None] = mapped_column(SmallInteger)
    kind: Mapped[str] = mapped_column(String(20))
    payload: Mapped[dict[str, Any]]
    replaces: Mapped[list[Any]] = mapped_column(server_default="[]")
    """Identifiers of the entries that this one corrects or decides between."""
    device_time: Mapped[datetime]
    clock_offset_ms: Mapped[int | None] = mapped_column(BigInteger)
    received_at: Mapped[datetime] = mapped_column(server_default=func.now())
    entered_by: Mapped[str] = mapped_column(String(254))


_SIGNED = (Plan.visit_id == Visit.id, Plan.status == "approved", Plan.blinded)
# a column of the visit costs a list of visits no query
Visit.sealed = column_property(sa.exists().where(*_SIGNED, Plan.key_opened_at.is_(None)).correlate(Visit.__table__))
_OPENED = sa.select(func.max(Plan.key_opened_at)).where(*_SIGNED)
Visit.unsealed_at = column_property(_OPENED.correlate(Visit.__table__).scalar_subquery())
_LETTER = sa.select(PlanItem.label).where(PlanItem.id == StudySession.plan_item_id)
StudySession.letter = column_property(_LETTER.correlate(StudySession.__table__).scalar_subquery())
