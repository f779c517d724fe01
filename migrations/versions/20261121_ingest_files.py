"""ingest files: proposed sessions, decisions on quarantined files, how beta is measured"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the tables of this revision: table, primary key, columns left out
AUDITED = (
    ("session_proposal", "session_id", ""),
)


def upgrade() -> None:
    """Proposals beside sessions, the fate of quarantined files, the measure of beta in the settings."""
    op.add_column("settings_version", sa.Column("beta_measure", sa.String(length=10), server_default="rms", nullable=False))
    op.create_check_constraint(op.f("ck_settings_version_beta_measure"), "settings_version", "beta_measure in ('rms', 'power')")

    op.alter_column("session", "controller", existing_type=sa.String(length=20), nullable=True)
    op.create_check_constraint(op.f("ck_session_controller_stated"), "session", "status = 'proposed' or controller is not null")
    op.create_table(
        "session_proposal",
        sa.Column("session_id", sa.Integer(), nullable=False),
        sa.Column("upload_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), server_default="1", nullable=False),
        sa.Column("visit_open", sa.Boolean(), nullable=False),
        sa.Column("evidence", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("changed_by", sa.String(length=254), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("version >= 1", name=op.f("ck_session_proposal_version")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_session_proposal_session_id_session"), ondelete="CASCADE"),
        sa.ForeignKeyConstraint(["upload_id"], ["upload.id"], name=op.f("fk_session_proposal_upload_id_upload")),
        sa.PrimaryKeyConstraint("session_id", name=op.f("pk_session_proposal")),
    )
    op.create_index(op.f("ix_session_proposal_upload_id"), "session_proposal", ["upload_id"], unique=False)

    for column in (
        sa.Column("session_id", sa.Integer(), nullable=True),
        sa.Column("released_sha256", sa.String(length=64), nullable=True),
        sa.Column("reviewed_by", sa.String(length=254), nullable=True),
        sa.Column("reviewed_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("decided_by", sa.String(length=254), nullable=True),
        sa.Column("decided_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("decision_reason", sa.Text(), nullable=True),
    ):
        op.add_column("upload_file", column)
    op.create_foreign_key(op.f("fk_upload_file_session_id_session"), "upload_file", "session", ["session_id"], ["id"], ondelete="SET NULL")
    op.create_foreign_key(op.f("fk_upload_file_released_sha256_stored_file"), "upload_file", "stored_file", ["released_sha256"], ["sha256"])
    op.create_index(op.f("ix_upload_file_session_id"), "upload_file", ["session_id"], unique=False)
    op.drop_constraint(op.f("ck_upload_file_status"), "upload_file", type_="check")
    op.create_check_constraint(
        op.f("ck_upload_file_status"), "upload_file", "status in ('received', 'decoded', 'failed', 'released', 'discarded')"
    )
    op.create_check_constraint(
        op.f("ck_upload_file_decision"), "upload_file", "(decided_at is null) = (decided_by is null) and (decided_at is null) = (decision_reason is null)"
    )
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )


def downgrade() -> None:
    """Back to sessions that are always confirmed; refuses while proposals without a controller or decided files exist."""
    op.drop_constraint(op.f("ck_upload_file_decision"), "upload_file", type_="check")
    op.drop_constraint(op.f("ck_upload_file_status"), "upload_file", type_="check")
    op.create_check_constraint(op.f("ck_upload_file_status"), "upload_file", "status in ('received', 'decoded', 'failed')")
    op.drop_index(op.f("ix_upload_file_session_id"), table_name="upload_file")
    for column in ("decision_reason", "decided_at", "decided_by", "reviewed_at", "reviewed_by", "released_sha256", "session_id"):
        op.drop_column("upload_file", column)
    op.drop_table("session_proposal")
    op.drop_constraint(op.f("ck_session_controller_stated"), "session", type_="check")
    op.alter_column("session", "controller", existing_type=sa.String(length=20), nullable=False)
    op.drop_column("settings_version", "beta_measure")
