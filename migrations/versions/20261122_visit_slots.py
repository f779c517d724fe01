"""planning: electronic signatures; a plan's sessions have limits and are linked to what was done; blinded plans have a sealed key"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the tables of this revision: table, primary key, columns left out
AUDITED = (("signature", "id", "content"),)
NEVER_CHANGED = ("signature",)


def upgrade() -> None:
    op.create_table(
        "signature",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("subject_kind", sa.String(length=40), nullable=False),
        sa.Column("subject_id", sa.Integer(), nullable=False),
        sa.Column("meaning", sa.String(length=200), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("content", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("signed_by", sa.Integer(), nullable=False),
        sa.Column("signer", sa.String(length=254), nullable=False),
        sa.Column("signed_at", sa.DateTime(timezone=True), server_default=sa.text("clock_timestamp()"), nullable=False),
        sa.CheckConstraint("sha256 ~ '^[0-9a-f]{64}$'", name=op.f("ck_signature_sha256")),
        sa.CheckConstraint("meaning <> '' and subject_kind <> ''", name=op.f("ck_signature_stated")),
        sa.ForeignKeyConstraint(["signed_by"], ["app_user.id"], name=op.f("fk_signature_signed_by_app_user")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_signature")),
    )
    op.create_index("ix_signature_subject", "signature", ["subject_kind", "subject_id"], unique=False)
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
    for table in NEVER_CHANGED:
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")
    _slots()
    _plans()
    op.add_column("session", sa.Column("plan_item_id", sa.Integer(), nullable=True))
    op.create_foreign_key(op.f("fk_session_plan_item_id_plan_item"), "session", "plan_item", ["plan_item_id"], ["id"])
    op.create_unique_constraint(op.f("uq_session_plan_item_id"), "session", ["plan_item_id"])


def _slots() -> None:
    op.add_column("plan_item", sa.Column("hemisphere", sa.String(length=5), nullable=True))
    for name in ("cdbs_ma", "min_ma", "max_ma", "ramp_ma_per_s"):
        op.add_column("plan_item", sa.Column(name, sa.Float(), nullable=True))
    op.add_column("plan_item", sa.Column("repeat", sa.SmallInteger(), server_default="1", nullable=False))
    op.add_column("plan_item", sa.Column("label", sa.String(length=10), nullable=True))
    op.add_column("plan_item", sa.Column("break_minutes", sa.Float(), server_default="0", nullable=False))
    op.add_column("plan_item", sa.Column("medication", sa.Text(), server_default="", nullable=False))
    op.create_check_constraint(op.f("ck_plan_item_hemisphere"), "plan_item", "hemisphere in ('left', 'right')")
    op.create_check_constraint(op.f("ck_plan_item_limits"), "plan_item", "min_ma >= 0 and min_ma <= max_ma and ramp_ma_per_s > 0 and cdbs_ma > 0")
    op.create_check_constraint(op.f("ck_plan_item_repeat"), "plan_item", '"repeat" >= 1')
    op.create_check_constraint(op.f("ck_plan_item_break_minutes"), "plan_item", "break_minutes >= 0")


def _plans() -> None:
    op.add_column("plan", sa.Column("blinded", sa.Boolean(), server_default=sa.text("false"), nullable=False))
    op.add_column("plan", sa.Column("starts_at", sa.Time(), nullable=True))
    op.add_column("plan", sa.Column("key_opened_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column("plan", sa.Column("key_opened_by", sa.String(length=254), nullable=True))
    op.add_column("plan", sa.Column("key_opened_reason", sa.Text(), nullable=True))
    op.add_column("plan", sa.Column("key_opened_in_emergency", sa.Boolean(), server_default=sa.text("false"), nullable=False))
    op.create_check_constraint(op.f("ck_plan_key_opened"), "plan", "(key_opened_at is null) = (key_opened_by is null)")
    op.create_check_constraint(
        op.f("ck_plan_key_reason"), "plan", "key_opened_at is null or key_opened_in_emergency or key_opened_reason is not null"
    )


def downgrade() -> None:
    op.drop_constraint(op.f("uq_session_plan_item_id"), "session", type_="unique")
    op.drop_column("session", "plan_item_id")
    for name in ("key_opened_in_emergency", "key_opened_reason", "key_opened_by", "key_opened_at", "starts_at", "blinded"):
        op.drop_column("plan", name)
    for name in ("medication", "break_minutes", "label", "repeat", "ramp_ma_per_s", "max_ma", "min_ma", "cdbs_ma", "hemisphere"):
        op.drop_column("plan_item", name)
    op.drop_table("signature")
