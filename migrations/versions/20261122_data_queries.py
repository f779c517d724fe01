"""Data queries: questions about values, in entries that are only added."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0024"
down_revision = "0023"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the tables of this revision: table, primary key, columns left out
AUDITED = (("data_query", "id", ""), ("data_query_entry", "id", ""))


def upgrade() -> None:
    op.create_table(
        "data_query",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("session_id", sa.Integer(), nullable=True),
        sa.Column("upload_id", sa.Integer(), nullable=True),
        sa.Column("field", sa.String(length=20), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("(session_id is null) <> (upload_id is null)", name=op.f("ck_data_query_one_subject")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_data_query_participant_id_participant")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_data_query_session_id_session")),
        sa.ForeignKeyConstraint(["upload_id"], ["upload.id"], name=op.f("fk_data_query_upload_id_upload")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_data_query")),
    )
    op.create_table(
        "data_query_entry",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("query_id", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("value", sa.Text(), nullable=True),
        sa.Column("entered_by", sa.String(length=254), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("state in ('open', 'answered', 'closed')", name=op.f("ck_data_query_entry_state")),
        sa.CheckConstraint("text <> ''", name=op.f("ck_data_query_entry_text")),
        sa.ForeignKeyConstraint(["query_id"], ["data_query.id"], name=op.f("fk_data_query_entry_query_id_data_query")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_data_query_entry")),
    )
    for table, column in (
        ("data_query", "participant_id"),
        ("data_query", "session_id"),
        ("data_query", "upload_id"),
        ("data_query_entry", "query_id"),
    ):
        op.create_index(op.f(f"ix_{table}_{column}"), table, [column], unique=False)
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")


def downgrade() -> None:
    op.drop_table("data_query_entry")
    op.drop_table("data_query")
