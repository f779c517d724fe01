"""Characteristics of participants, doses of medication with their times, activity before a session; pinned by snapshots."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0026"
down_revision = "0025"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the tables of this revision: table, primary key, columns left out
AUDITED = (("characteristics_version", "id", ""), ("dose", "id", ""))
DRUGS = (
    "levodopa", "levodopa_cr", "levodopa_comt", "levodopa_equivalent", "apomorphine", "pramipexole", "ropinirole", "rotigotine",
    "selegiline", "rasagiline", "safinamide", "amantadine", "anticholinergic", "muscle_relaxant", "other",
)  # fmt: skip
ACTIVITIES = ("rest", "light", "exercise", "meal", "sleep")


def _listed(words: tuple[str, ...]) -> str:
    return ", ".join(f"'{word}'" for word in words)


def upgrade() -> None:
    op.create_table(
        "characteristics_version",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("leads", postgresql.JSONB(), server_default="[]", nullable=False),
        sa.Column("symptoms", postgresql.JSONB(), server_default="[]", nullable=False),
        sa.Column("hand", sa.String(length=5), nullable=True),
        sa.Column("medication", postgresql.JSONB(), server_default="[]", nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.CheckConstraint("hand in ('left', 'right')", name=op.f("ck_characteristics_version_hand")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_characteristics_version_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_characteristics_version")),
        sa.UniqueConstraint("participant_id", "version", name=op.f("uq_characteristics_version_participant_id_version")),
    )
    op.create_index(op.f("ix_characteristics_version_participant_id"), "characteristics_version", ["participant_id"], unique=False)
    op.create_table(
        "dose",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("visit_id", sa.Integer(), nullable=False),
        sa.Column("drug", sa.String(length=30), nullable=False),
        sa.Column("mg", sa.Float(), nullable=False),
        sa.Column("taken_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("entered_by", sa.String(length=254), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint(f"drug in ({_listed(DRUGS)})", name=op.f("ck_dose_drug")),
        sa.CheckConstraint("mg > 0 and mg <= 5000", name=op.f("ck_dose_mg")),
        sa.CheckConstraint("taken_at >= '1990-01-01Z' and taken_at < '2201-01-01Z'", name=op.f("ck_dose_taken_at")),
        sa.ForeignKeyConstraint(["visit_id"], ["visit.id"], name=op.f("fk_dose_visit_id_visit")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_dose")),
        sa.UniqueConstraint("visit_id", "drug", "taken_at", name=op.f("uq_dose_visit_id_drug_taken_at")),
    )
    op.create_index(op.f("ix_dose_visit_id"), "dose", ["visit_id"], unique=False)
    op.add_column("session", sa.Column("activity", sa.String(length=10), nullable=True))
    op.create_check_constraint(op.f("ck_session_activity"), "session", f"activity in ({_listed(ACTIVITIES)})")
    op.add_column("snapshot_session", sa.Column("hours_since_dose", sa.Float(), nullable=True))
    op.add_column("buffer_snapshot", sa.Column("characteristics_id", sa.Integer(), nullable=True))
    op.create_foreign_key(
        op.f("fk_buffer_snapshot_characteristics_id_characteristics_version"),
        "buffer_snapshot", "characteristics_version", ["characteristics_id"], ["id"],
    )  # fmt: skip
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
    op.execute(
        "create trigger never_changed before update or delete on characteristics_version for each row execute function refuse_change()"
    )


def downgrade() -> None:
    op.drop_constraint(op.f("fk_buffer_snapshot_characteristics_id_characteristics_version"), "buffer_snapshot")
    op.drop_column("buffer_snapshot", "characteristics_id")
    op.drop_column("snapshot_session", "hours_since_dose")
    op.drop_constraint(op.f("ck_session_activity"), "session")
    op.drop_column("session", "activity")
    op.drop_table("dose")
    op.drop_table("characteristics_version")
