"""planning: bundles that left stand in a table of their own; learning: scores of controllers without learning are named baselines"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the tables of this revision: table, primary key, columns left out
AUDITED = (("bundle_release", "id", ""),)
NEVER_CHANGED = ("bundle_release",)

_NUMBER = r"([0-9.]+(?:e[+-]?[0-9]+)?)"
_REASON = (
    rf"^controller bundle of .+, policy ([0-9]+)(?:, (left|right))?: {_NUMBER} to {_NUMBER} mA, cDBS {_NUMBER} mA, ramp {_NUMBER} mA/s$"
)


def upgrade() -> None:
    """Releases in rows. Those so far stood in the reasons of the audit trail alone and are read from there, where they parse."""
    op.create_table(
        "bundle_release",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("policy_id", sa.Integer(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("hemisphere", sa.String(length=10), nullable=True),
        sa.Column("min_ma", sa.Float(), nullable=False),
        sa.Column("max_ma", sa.Float(), nullable=False),
        sa.Column("cdbs_ma", sa.Float(), nullable=False),
        sa.Column("ramp_ma_per_s", sa.Float(), nullable=False),
        sa.Column("approvals", postgresql.JSONB(astext_type=sa.Text()), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint("hemisphere in ('left', 'right')", name=op.f("ck_bundle_release_hemisphere")),
        sa.CheckConstraint(
            "min_ma >= 0 and min_ma <= cdbs_ma and cdbs_ma <= max_ma and ramp_ma_per_s > 0", name=op.f("ck_bundle_release_limits")
        ),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_bundle_release_participant_id_participant")),
        sa.ForeignKeyConstraint(["policy_id"], ["policy.id"], name=op.f("fk_bundle_release_policy_id_policy")),
        sa.ForeignKeyConstraint(["sha256"], ["stored_file.sha256"], name=op.f("fk_bundle_release_sha256_stored_file")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_bundle_release")),
    )
    op.create_index(op.f("ix_bundle_release_participant_id"), "bundle_release", ["participant_id"], unique=False)
    op.create_index(op.f("ix_bundle_release_policy_id"), "bundle_release", ["policy_id"], unique=False)
    # before the table is audited: what is copied here has its audit events already
    op.get_bind().execute(
        sa.text(
            "insert into bundle_release"
            " (participant_id, policy_id, sha256, hemisphere, min_ma, max_ma, cdbs_ma, ramp_ma_per_s, created_at, created_by)"
            " select p.participant_id, p.id, f.sha256, m[2], m[3]::float, m[4]::float, m[5]::float, m[6]::float, e.at, e.actor"
            " from audit_event e cross join lateral regexp_match(e.reason, :reason) m"
            " join policy p on p.id = m[1]::bigint join stored_file f on f.sha256 = e.entity_id"
            " where e.entity = 'stored_file' and e.action = 'insert' and m[3]::float <= m[5]::float and m[5]::float <= m[4]::float"
            " and m[6]::float > 0 order by e.id"
        ),
        {"reason": _REASON},
    )
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
    for table in NEVER_CHANGED:
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")
    op.alter_column("sweep", "yardsticks", new_column_name="baselines")


def downgrade() -> None:
    """Without releases, which the audit trail holds too."""
    op.alter_column("sweep", "baselines", new_column_name="yardsticks")
    op.drop_table("bundle_release")
