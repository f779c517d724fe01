"""Column mappings: how tables that no decoder knows are read in a study."""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0027"
down_revision = "0026"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the tables of this revision: table, primary key, columns left out
AUDITED = (("column_mapping", "id", ""),)
NEVER_CHANGED = ("column_mapping",)


def upgrade() -> None:
    op.create_table(
        "column_mapping",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.Integer(), nullable=False),
        sa.Column("header", sa.String(length=64), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("mapping", postgresql.JSONB(), nullable=False),
        sa.Column("labels", postgresql.JSONB(), nullable=False),
        sa.Column("removed", sa.Boolean(), server_default=sa.text("false"), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.CheckConstraint("version >= 1", name=op.f("ck_column_mapping_version")),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_column_mapping_study_id_study")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_column_mapping")),
        sa.UniqueConstraint("study_id", "header", "version", name=op.f("uq_column_mapping_study_id_header_version")),
    )
    op.create_index(op.f("ix_column_mapping_study_id"), "column_mapping", ["study_id"], unique=False)
    op.add_column("upload_file", sa.Column("column_mapping_id", sa.Integer(), nullable=True))
    op.create_foreign_key(
        op.f("fk_upload_file_column_mapping_id_column_mapping"), "upload_file", "column_mapping", ["column_mapping_id"], ["id"]
    )
    op.create_index(op.f("ix_upload_file_column_mapping_id"), "upload_file", ["column_mapping_id"], unique=False)
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
    for table in NEVER_CHANGED:
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")


def downgrade() -> None:
    op.drop_index(op.f("ix_upload_file_column_mapping_id"), "upload_file")
    op.drop_constraint(op.f("fk_upload_file_column_mapping_id_column_mapping"), "upload_file", type_="foreignkey")
    op.drop_column("upload_file", "column_mapping_id")
    op.drop_table("column_mapping")
