"""learning: decisions on the gate of the replay buffer, sweeps"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the tables of this revision: table, primary key, columns left out
AUDITED = (("buffer_gate_decision", "id", ""), ("sweep", "id", ""))
NEVER_CHANGED = ("buffer_gate_decision", "sweep")


def upgrade() -> None:
    """Who let sessions of learned policies into a buffer, or kept them out, and why; which policies were trained together."""
    op.create_table(
        "buffer_gate_decision",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("choice", sa.String(length=10), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint("choice in ('open', 'shut', 'test')", name=op.f("ck_buffer_gate_decision_choice")),
        sa.CheckConstraint("reason <> ''", name=op.f("ck_buffer_gate_decision_reason")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_buffer_gate_decision_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_buffer_gate_decision")),
    )
    op.create_index(op.f("ix_buffer_gate_decision_participant_id"), "buffer_gate_decision", ["participant_id"], unique=False)
    op.create_table(
        "sweep",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("snapshot_id", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.String(length=36), nullable=False),
        sa.Column("config", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("yardsticks", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("code_version", sa.String(length=80), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_sweep_participant_id_participant")),
        sa.ForeignKeyConstraint(["snapshot_id"], ["buffer_snapshot.id"], name=op.f("fk_sweep_snapshot_id_buffer_snapshot")),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_sweep_job_id_job")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_sweep")),
        sa.UniqueConstraint("participant_id", "name", name=op.f("uq_sweep_participant_id_name")),
        sa.UniqueConstraint("job_id", name=op.f("uq_sweep_job_id")),
    )
    op.create_index(op.f("ix_sweep_participant_id"), "sweep", ["participant_id"], unique=False)
    op.add_column("policy", sa.Column("sweep_id", sa.Integer(), nullable=True))
    op.create_foreign_key(op.f("fk_policy_sweep_id_sweep"), "policy", "sweep", ["sweep_id"], ["id"])
    op.create_index(op.f("ix_policy_sweep_id"), "policy", ["sweep_id"], unique=False)
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
    for table in NEVER_CHANGED:
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")


def downgrade() -> None:
    """Without gate and sweeps."""
    op.drop_index(op.f("ix_policy_sweep_id"), table_name="policy")
    op.drop_column("policy", "sweep_id")
    op.drop_table("sweep")
    op.drop_table("buffer_gate_decision")
