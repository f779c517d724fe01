"""Tables of outcomes: a column per outcome and margin from `ml.outcomes`, and what uploaded files say of them."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Any

from sqlalchemy import (
    CheckConstraint,
    Double,
    ForeignKey,
    Index,
    LargeBinary,
    SmallInteger,
    String,
    Text,
    UniqueConstraint,
    func,
)
from sqlalchemy.orm import Mapped, mapped_column, relationship

from app.platform.database import ONE_STANDING, Base, column_info
from app.tables.participants import Hemisphere
from ml.outcomes import BUILT_IN, OUTCOMES
from ml.outcomes.records import Outcome

if TYPE_CHECKING:
    from app.tables.sessions import StudySession


def value_checks() -> tuple[CheckConstraint, ...]:
    """Return the range of each outcome as a constraint of its column."""
    return tuple(CheckConstraint(_range(o), name=o.key) for o in OUTCOMES)


class HasOutcomes:
    """A row with a column per outcome."""

    def value(self, outcome: Outcome) -> float | None:
        """Return the value of an outcome; None where not measured."""
        found: float | None = getattr(self, outcome.field)
        return found


def add_value_columns(table: type[Base]) -> None:
    """Add a column per outcome to a table, null where not measured."""
    for o in OUTCOMES:
        fixed = {"check": _range(o), "unit": o.unit, "higher_is_better": o.higher_is_better, "whole": o.whole}
        kind = SmallInteger if o.whole else Double
        setattr(table, o.field, mapped_column(kind, nullable=True, info=column_info(None if o in BUILT_IN else fixed)))


def _range(o: Outcome) -> str:
    if o.below is not None:
        return f"{o.field} >= {o.low:g} and {o.field} < {o.below:g}"
    return f"{o.field} between {o.low:g} and {o.high:g}"


class QocRevision(HasOutcomes, Base):
    """End-of-session QoCs of a session, a column per outcome; a correction is a new revision."""

    __tablename__ = "qoc"
    __table_args__ = (
        UniqueConstraint("session_id", "revision"),
        *value_checks(),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    session_id: Mapped[int] = mapped_column(ForeignKey("session.id", ondelete="CASCADE"), index=True)
    revision: Mapped[int]
    entered_by: Mapped[str] = mapped_column(String(254))
    reason: Mapped[str | None] = mapped_column(Text)
    derived: Mapped[list[Any]] = mapped_column(server_default="[]")
    """Names of the QoCs whose values in this revision were derived from uploaded files."""
    from_day: Mapped[list[Any]] = mapped_column(server_default="[]")
    """Names of those that have, or lack, a value as the clinic day has it: they follow its later entries."""
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    session: Mapped[StudySession] = relationship(back_populates="qocs")


add_value_columns(QocRevision)


class TremorSeries(Base):
    """Minutes of tremor from one uploaded file of a watch, in UTC.

    Little-endian arrays of `n` minutes in time order: `start_unix_s_f64` and `duration_s_f64` in seconds, `fractions_f32` [n, 6] in the
    order of `ml.qoc.TREMOR_CLASSES`, `any_tremor_f32`. NaN where the export has no value. Minutes that a newer reading of the file
    replaced are marked as removed and ignored.
    """

    __tablename__ = "tremor_series"
    __table_args__ = (
        Index("uq_tremor_series_participant_id_upload_file_id", "participant_id", "upload_file_id", **ONE_STANDING),
        CheckConstraint("n >= 1", name="minutes"),
        CheckConstraint("last_end_at > first_start_at", name="order"),
        CheckConstraint(
            "octet_length(start_unix_s_f64) = 8 * n and octet_length(duration_s_f64) = 8 * n"
            " and octet_length(fractions_f32) = 24 * n and octet_length(any_tremor_f32) = 4 * n",
            name="length",
        ),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    participant_id: Mapped[int] = mapped_column(ForeignKey("participant.id"))
    upload_file_id: Mapped[int] = mapped_column(ForeignKey("upload_file.id"), index=True)
    first_start_at: Mapped[datetime]
    last_end_at: Mapped[datetime]
    n: Mapped[int]
    start_unix_s_f64: Mapped[bytes] = mapped_column(LargeBinary)
    duration_s_f64: Mapped[bytes] = mapped_column(LargeBinary)
    fractions_f32: Mapped[bytes] = mapped_column(LargeBinary)
    any_tremor_f32: Mapped[bytes] = mapped_column(LargeBinary)
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    removed_at: Mapped[datetime | None]


class GraspTest(Base):
    """One hand's grasp test near the end of a session: times of open fists, s (little-endian float64, `n` of them).

    `implausible` lists which of the n - 1 intervals between them are too short or too long to be a grasp. A test that a newer reading
    replaced, or that belongs to another session, is marked as removed and ignored. It stays when its proposal is given up.
    """

    __tablename__ = "grasp_test"
    __table_args__ = (
        Index(
            "uq_grasp_test_session_id_upload_file_id_hand",
            "session_id",
            "upload_file_id",
            "hand",
            postgresql_nulls_not_distinct=True,
            **ONE_STANDING,
        ),
        CheckConstraint("session_id is not null or removed_at is not null", name="belongs"),
        CheckConstraint("hand in ('left', 'right')", name="hand"),
        CheckConstraint("n >= 1 and octet_length(open_fist_s_f64) = 8 * n", name="length"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    session_id: Mapped[int | None] = mapped_column(ForeignKey("session.id", ondelete="SET NULL"))
    upload_file_id: Mapped[int] = mapped_column(ForeignKey("upload_file.id"), index=True)
    hand: Mapped[Hemisphere | None] = mapped_column(String(5))
    n: Mapped[int]
    open_fist_s_f64: Mapped[bytes] = mapped_column(LargeBinary)
    implausible: Mapped[list[Any]]
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())
    removed_at: Mapped[datetime | None]
