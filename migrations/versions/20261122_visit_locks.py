"""Locks of visits and of margins, blinded assessors; sessions say whether they were stopped and when the last dose was."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the tables of this revision: table, primary key, columns left out
AUDITED = (("visit_lock", "id", ""), ("margins_lock", "id", ""))
NEVER_CHANGED = ("visit_lock", "margins_lock")


def upgrade() -> None:
    op.create_table(
        "visit_lock",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("visit_id", sa.Integer(), nullable=False),
        sa.Column("locked", sa.Boolean(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint("reason <> ''", name=op.f("ck_visit_lock_reason")),
        sa.ForeignKeyConstraint(["visit_id"], ["visit.id"], name=op.f("fk_visit_lock_visit_id_visit")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_visit_lock")),
    )
    op.create_index(op.f("ix_visit_lock_visit_id"), "visit_lock", ["visit_id"], unique=False)
    op.create_table(
        "margins_lock",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("margins_version_id", sa.Integer(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint("reason <> ''", name=op.f("ck_margins_lock_reason")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_margins_lock_participant_id_participant")),
        sa.ForeignKeyConstraint(
            ["margins_version_id"], ["margins_version.id"], name=op.f("fk_margins_lock_margins_version_id_margins_version")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_margins_lock")),
    )
    op.create_index(op.f("ix_margins_lock_participant_id"), "margins_lock", ["participant_id"], unique=False)
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
    for table in NEVER_CHANGED:
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")
    op.add_column("session", sa.Column("stopped_reason", sa.Text(), nullable=True))
    op.add_column("session", sa.Column("medication_h", sa.Float(), nullable=True))
    op.create_check_constraint(op.f("ck_session_stopped_reason"), "session", "stopped_reason is null or stopped_reason <> ''")
    op.create_check_constraint(op.f("ck_session_medication"), "session", "medication_h >= 0 and medication_h <= 72")
    op.drop_constraint(op.f("ck_membership_role"), "membership", type_="check")
    op.create_check_constraint(
        op.f("ck_membership_role"), "membership", "role in ('blinded_assessor', 'viewer', 'clinician', 'engineer', 'admin')"
    )


def downgrade() -> None:
    op.drop_constraint(op.f("ck_membership_role"), "membership", type_="check")
    op.create_check_constraint(op.f("ck_membership_role"), "membership", "role in ('viewer', 'clinician', 'engineer', 'admin')")
    op.drop_constraint(op.f("ck_session_medication"), "session", type_="check")
    op.drop_constraint(op.f("ck_session_stopped_reason"), "session", type_="check")
    op.drop_column("session", "medication_h")
    op.drop_column("session", "stopped_reason")
    op.drop_table("margins_lock")
    op.drop_table("visit_lock")
