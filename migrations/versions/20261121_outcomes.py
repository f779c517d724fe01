"""outcomes: minutes of tremor, hand-grasp tests, and which QoCs of a revision were derived from them"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the new tables: table, primary key, columns left out
AUDITED = (
    ("tremor_series", "id", "start_unix_s_f64,duration_s_f64,fractions_f32,any_tremor_f32"),
    ("grasp_test", "id", "open_fist_s_f64"),
)


def upgrade() -> None:
    op.add_column("qoc", sa.Column("derived", postgresql.JSONB(astext_type=sa.Text()), server_default="[]", nullable=False))
    op.create_table(
        "tremor_series",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("upload_file_id", sa.Integer(), nullable=False),
        sa.Column("first_start_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("last_end_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("n", sa.Integer(), nullable=False),
        sa.Column("start_unix_s_f64", sa.LargeBinary(), nullable=False),
        sa.Column("duration_s_f64", sa.LargeBinary(), nullable=False),
        sa.Column("fractions_f32", sa.LargeBinary(), nullable=False),
        sa.Column("any_tremor_f32", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("n >= 1", name=op.f("ck_tremor_series_minutes")),
        sa.CheckConstraint("last_end_at > first_start_at", name=op.f("ck_tremor_series_order")),
        sa.CheckConstraint(
            "octet_length(start_unix_s_f64) = 8 * n and octet_length(duration_s_f64) = 8 * n"
            " and octet_length(fractions_f32) = 24 * n and octet_length(any_tremor_f32) = 4 * n",
            name=op.f("ck_tremor_series_length"),
        ),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_tremor_series_participant_id_participant")),
        sa.ForeignKeyConstraint(["upload_file_id"], ["upload_file.id"], name=op.f("fk_tremor_series_upload_file_id_upload_file")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_tremor_series")),
        sa.UniqueConstraint("participant_id", "upload_file_id", name=op.f("uq_tremor_series_participant_id_upload_file_id")),
    )
    op.create_index(op.f("ix_tremor_series_upload_file_id"), "tremor_series", ["upload_file_id"], unique=False)
    op.create_table(
        "grasp_test",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("session_id", sa.Integer(), nullable=False),
        sa.Column("upload_file_id", sa.Integer(), nullable=False),
        sa.Column("hand", sa.String(length=5), nullable=True),
        sa.Column("n", sa.Integer(), nullable=False),
        sa.Column("open_fist_s_f64", sa.LargeBinary(), nullable=False),
        sa.Column("implausible", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("hand in ('left', 'right')", name=op.f("ck_grasp_test_hand")),
        sa.CheckConstraint("n >= 1 and octet_length(open_fist_s_f64) = 8 * n", name=op.f("ck_grasp_test_length")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_grasp_test_session_id_session"), ondelete="CASCADE"),
        sa.ForeignKeyConstraint(["upload_file_id"], ["upload_file.id"], name=op.f("fk_grasp_test_upload_file_id_upload_file")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_grasp_test")),
        sa.UniqueConstraint(
            "session_id",
            "upload_file_id",
            "hand",
            name=op.f("uq_grasp_test_session_id_upload_file_id_hand"),
            postgresql_nulls_not_distinct=True,
        ),
    )
    op.create_index(op.f("ix_grasp_test_upload_file_id"), "grasp_test", ["upload_file_id"], unique=False)
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )


def downgrade() -> None:
    for table, _, _ in AUDITED:
        op.execute(f"drop trigger audit on {table}")
    op.drop_index(op.f("ix_grasp_test_upload_file_id"), table_name="grasp_test")
    op.drop_table("grasp_test")
    op.drop_index(op.f("ix_tremor_series_upload_file_id"), table_name="tremor_series")
    op.drop_table("tremor_series")
    op.drop_column("qoc", "derived")
