"""Data queries about visits, doses, adverse events, settings and characteristics."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0038"
down_revision = "0036"
branch_labels = None
depends_on = None

SUBJECT, RECORD = "ck_data_query_one_subject", "ck_data_query_record"
KEYS = (("visit_id", "visit"), ("event_id", "adverse_event"))


def upgrade() -> None:
    for column, table in KEYS:
        op.add_column("data_query", sa.Column(column, sa.Integer(), nullable=True))
        op.create_foreign_key(op.f(f"fk_data_query_{column}_{table}"), "data_query", table, [column], ["id"])
        op.create_index(op.f(f"ix_data_query_{column}"), "data_query", [column], unique=False)
    op.add_column("data_query", sa.Column("dose_id", sa.Integer(), nullable=True))
    op.add_column("data_query", sa.Column("record", sa.String(length=20), nullable=True))
    op.alter_column("data_query", "field", type_=sa.String(length=40), existing_type=sa.String(length=20), existing_nullable=False)
    op.drop_constraint(op.f(SUBJECT), "data_query", type_="check")
    op.create_check_constraint(op.f(SUBJECT), "data_query", "num_nonnulls(session_id, upload_id, visit_id, dose_id, event_id, record) = 1")
    op.create_check_constraint(op.f(RECORD), "data_query", "record in ('settings', 'characteristics')")


def downgrade() -> None:
    op.drop_constraint(op.f(RECORD), "data_query", type_="check")
    op.drop_constraint(op.f(SUBJECT), "data_query", type_="check")
    # what is asked about other things cannot be told by the columns before; such rows stay, and the rule holds for those that follow
    op.create_check_constraint(op.f(SUBJECT), "data_query", "(session_id is null) <> (upload_id is null)", postgresql_not_valid=True)
    op.alter_column("data_query", "field", type_=sa.String(length=20), existing_type=sa.String(length=40), existing_nullable=False)
    op.drop_column("data_query", "record")
    op.drop_column("data_query", "dose_id")
    for column, table in KEYS:
        op.drop_constraint(op.f(f"fk_data_query_{column}_{table}"), "data_query", type_="foreignkey")
        op.drop_column("data_query", column)
