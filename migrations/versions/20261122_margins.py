"""Margins against cDBS and levels of verdicts, versioned; every participant of before gets the defaults as version 1."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the tables of this revision: table, primary key, columns left out
AUDITED = (("margins_version", "id", ""),)
NEVER_CHANGED = ("margins_version",)
MARGINS = ("grasp_share", "rating_points", "tremor_points", "test_within", "test_saves", "unsafe_beyond", "nearly_off_share")


def upgrade() -> None:
    op.create_table(
        "margins_version",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        *(sa.Column(name, sa.Float(), nullable=False) for name in MARGINS),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.CheckConstraint(
            "grasp_share > 0 and grasp_share < 1 and rating_points > 0 and tremor_points > 0", name=op.f("ck_margins_version_margins")
        ),
        sa.CheckConstraint(
            "test_within > 0 and test_within < 1 and test_saves > 0 and test_saves < 1 and unsafe_beyond > 0 and unsafe_beyond < 1"
            " and nearly_off_share >= 0 and nearly_off_share < 1",
            name=op.f("ck_margins_version_levels"),
        ),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_margins_version_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_margins_version")),
        sa.UniqueConstraint("participant_id", "version", name=op.f("uq_margins_version_participant_id_version")),
    )
    op.create_index(op.f("ix_margins_version_participant_id"), "margins_version", ["participant_id"], unique=False)
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
    op.execute(
        f"insert into margins_version (participant_id, version, {', '.join(MARGINS)}, created_by, reason)"
        " select id, 1, 0.1, 1, 10, 0.8, 0.9, 0.5, 0.2, 'betaloop', 'the defaults, which rankings used before there was a choice'"
        " from participant order by id"
    )
    for table in NEVER_CHANGED:
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")


def downgrade() -> None:
    op.drop_table("margins_version")
