"""What is entered on the clinic day; rows are only added."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the table of this revision: table, primary key, columns left out
AUDITED = (("day_entry", "id", ""),)
KINDS = (
    "start", "stop", "stop_cause", "rating", "grasp", "dyskinesia", "speech", "gait", "note", "adverse_event", "skip", "repeat",
    "session_end", "clinical_settings",
)
OF_THE_DAY = ("note", "adverse_event", "clinical_settings")


def _listed(kinds: tuple[str, ...]) -> str:
    return ", ".join(f"'{kind}'" for kind in kinds)


def upgrade() -> None:
    op.create_table(
        "day_entry",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("uuid", sa.Uuid(), nullable=False),
        sa.Column("plan_id", sa.Integer(), nullable=False),
        sa.Column("plan_item_id", sa.Integer(), nullable=True),
        sa.Column("attempt", sa.SmallInteger(), nullable=True),
        sa.Column("kind", sa.String(length=20), nullable=False),
        sa.Column("payload", postgresql.JSONB(), nullable=False),
        sa.Column("replaces", postgresql.JSONB(), server_default="[]", nullable=False),
        sa.Column("device_time", sa.DateTime(timezone=True), nullable=False),
        sa.Column("clock_offset_ms", sa.BigInteger(), nullable=True),
        sa.Column("received_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("entered_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint(f"kind in ({_listed(KINDS)})", name=op.f("ck_day_entry_kind")),
        sa.CheckConstraint("(plan_item_id is null) = (attempt is null) and attempt >= 1", name=op.f("ck_day_entry_attempt")),
        sa.CheckConstraint(f"plan_item_id is not null or kind in ({_listed(OF_THE_DAY)})", name=op.f("ck_day_entry_session")),
        sa.ForeignKeyConstraint(["plan_id"], ["plan.id"], name=op.f("fk_day_entry_plan_id_plan")),
        sa.ForeignKeyConstraint(["plan_item_id"], ["plan_item.id"], name=op.f("fk_day_entry_plan_item_id_plan_item")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_day_entry")),
        sa.UniqueConstraint("uuid", name=op.f("uq_day_entry_uuid")),
    )
    for column in ("plan_id", "plan_item_id"):
        op.create_index(op.f(f"ix_day_entry_{column}"), "day_entry", [column], unique=False)
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")


def downgrade() -> None:
    op.drop_table("day_entry")
