"""The same minutes of one device and side count once: a constraint over confirmed sessions; fuller copies supersede recordings."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None

# ranges instead of scalars with "=": an exclusion constraint over those would need an extension that not every PostgreSQL has
_ROWS = """
    select s.id, r.id, g.start_s,
      case when r.hemisphere is null then int4range(4 * r.device_id, 4 * r.device_id + 4)
           else int4range(4 * r.device_id + (r.hemisphere = 'right')::int, 4 * r.device_id + (r.hemisphere = 'right')::int + 1) end,
      tstzrange(r.started_at + make_interval(secs => g.start_s + 1),
                r.started_at + make_interval(secs => greatest(g.stop_s - 1, g.start_s + 1)))
    from session s join session_segment g on g.session_id = s.id join recording r on r.id = g.recording_id
    where s.status = 'confirmed' and s.excluded_reason is null and g.is_control and r.started_at is not null
"""
_COLUMNS = "counted_time (session_id, recording_id, start_s, device_side, span)"
_FUNCTIONS = (
    f"""
    create function count_time(which integer) returns void language plpgsql as $$
    begin
      delete from counted_time where session_id = which;
      insert into {_COLUMNS} {_ROWS} and s.id = which;
    end $$
    """,
    """
    create function count_time_of_segment() returns trigger language plpgsql as $$
    begin
      if tg_op <> 'INSERT' then perform count_time(old.session_id); end if;
      if tg_op <> 'DELETE' then perform count_time(new.session_id); end if;
      return null;
    end $$
    """,
    """
    create function count_time_of_session() returns trigger language plpgsql as $$
    begin
      perform count_time(new.id);
      return null;
    end $$
    """,
    """
    create function count_time_of_recording() returns trigger language plpgsql as $$
    begin
      perform count_time(g.session_id) from (select distinct session_id from session_segment where recording_id = new.id) g;
      return null;
    end $$
    """,
)
_TRIGGERS = (
    "create trigger count_time after insert or update or delete on session_segment for each row execute function count_time_of_segment()",
    "create trigger count_time after update of status, excluded_reason on session for each row execute function count_time_of_session()",
    "create trigger count_time after update of started_at, hemisphere, device_id on recording"
    " for each row execute function count_time_of_recording()",
)


def upgrade() -> None:
    """Where sessions of before have the same minutes twice, the first one counts; buffers leave the others out by name."""
    op.add_column("recording", sa.Column("superseded_by_id", sa.Integer(), nullable=True))
    op.create_foreign_key(op.f("fk_recording_superseded_by_id_recording"), "recording", "recording", ["superseded_by_id"], ["id"])
    op.create_index(op.f("ix_recording_superseded_by_id"), "recording", ["superseded_by_id"], unique=False)
    op.create_table(
        "counted_time",
        sa.Column("session_id", sa.Integer(), nullable=False),
        sa.Column("recording_id", sa.Integer(), nullable=False),
        sa.Column("start_s", sa.Float(), nullable=False),
        sa.Column("device_side", postgresql.INT4RANGE(), nullable=False),
        sa.Column("span", postgresql.TSTZRANGE(), nullable=False),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_counted_time_session_id_session"), ondelete="CASCADE"),
        sa.ForeignKeyConstraint(["recording_id"], ["recording.id"], name=op.f("fk_counted_time_recording_id_recording")),
        sa.PrimaryKeyConstraint("session_id", "recording_id", "start_s", name=op.f("pk_counted_time")),
    )
    constraint = "exclude using gist (device_side with &&, span with &&)"
    op.execute(f"alter table counted_time add constraint counted_time_once {constraint}")
    op.execute(f"insert into {_COLUMNS} {_ROWS} order by s.id, g.start_s on conflict do nothing")
    # deferrable only now: a constraint that can wait cannot be asked to pass over conflicts
    op.execute("alter table counted_time drop constraint counted_time_once")
    op.execute(f"alter table counted_time add constraint counted_time_once {constraint} deferrable initially immediate")
    for function in _FUNCTIONS:
        op.execute(function)
    for trigger in _TRIGGERS:
        op.execute(trigger)


def downgrade() -> None:
    for table in ("session_segment", "session", "recording"):
        op.execute(f"drop trigger count_time on {table}")
    for function in ("count_time_of_recording()", "count_time_of_session()", "count_time_of_segment()", "count_time(integer)"):
        op.execute(f"drop function {function}")
    op.drop_table("counted_time")
    op.drop_index(op.f("ix_recording_superseded_by_id"), "recording")
    op.drop_constraint(op.f("fk_recording_superseded_by_id_recording"), "recording", type_="foreignkey")
    op.drop_column("recording", "superseded_by_id")
