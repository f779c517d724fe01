"""Adverse events: what happened to a participant, in revisions that a clinician may clear."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the tables of this revision: table, primary key, columns left out
AUDITED = (("adverse_event", "id", ""), ("adverse_event_revision", "id", ""))
NEVER_CHANGED = ("adverse_event", "adverse_event_revision")


def upgrade() -> None:
    op.create_table(
        "adverse_event",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("visit_id", sa.Integer(), nullable=True),
        sa.Column("session_id", sa.Integer(), nullable=True),
        sa.Column("policy_id", sa.Integer(), nullable=True),
        sa.Column("occurred_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("entry_key", sa.String(length=64), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("entry_key <> ''", name=op.f("ck_adverse_event_entry_key")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_adverse_event_participant_id_participant")),
        sa.ForeignKeyConstraint(["visit_id"], ["visit.id"], name=op.f("fk_adverse_event_visit_id_visit")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_adverse_event_session_id_session")),
        sa.ForeignKeyConstraint(["policy_id"], ["policy.id"], name=op.f("fk_adverse_event_policy_id_policy")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_adverse_event")),
        sa.UniqueConstraint("participant_id", "entry_key", name=op.f("uq_adverse_event_participant_id_entry_key")),
    )
    for column in ("visit_id", "session_id", "policy_id"):
        op.create_index(op.f(f"ix_adverse_event_{column}"), "adverse_event", [column], unique=False)
    op.create_table(
        "adverse_event_revision",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("event_id", sa.Integer(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("kind", sa.String(length=30), nullable=True),
        sa.Column("severity", sa.String(length=10), nullable=False),
        sa.Column("serious", sa.Boolean(), nullable=False),
        sa.Column("note", sa.Text(), server_default="", nullable=False),
        sa.Column("cleared_reason", sa.Text(), nullable=True),
        sa.Column("entered_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("severity in ('none', 'mild', 'severe')", name=op.f("ck_adverse_event_revision_severity")),
        sa.CheckConstraint("severity = 'none' or kind is not null", name=op.f("ck_adverse_event_revision_kind_stated")),
        sa.CheckConstraint("severity <> 'none' or not serious", name=op.f("ck_adverse_event_revision_serious")),
        sa.CheckConstraint(
            "kind <> 'other' or severity = 'none' or note <> ''", name=op.f("ck_adverse_event_revision_other_described")
        ),
        sa.CheckConstraint(
            "cleared_reason is null or cleared_reason <> ''", name=op.f("ck_adverse_event_revision_cleared_reason")
        ),
        sa.ForeignKeyConstraint(["event_id"], ["adverse_event.id"], name=op.f("fk_adverse_event_revision_event_id_adverse_event")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_adverse_event_revision")),
        sa.UniqueConstraint("event_id", "revision", name=op.f("uq_adverse_event_revision_event_id_revision")),
    )
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
    for table in NEVER_CHANGED:
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")


def downgrade() -> None:
    op.drop_table("adverse_event_revision")
    op.drop_table("adverse_event")
