"""The optional second factor of a user."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0025"
down_revision = "0024"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the table of this revision: table, primary key, columns left out
AUDITED = (("second_factor", "user_id", "sealed_secret,recovery,last_used_at"),)


def upgrade() -> None:
    op.create_table(
        "second_factor",
        sa.Column("user_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("sealed_secret", sa.LargeBinary(), nullable=False),
        sa.Column("recovery", postgresql.JSONB(), nullable=False),
        sa.Column("confirmed_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("last_used_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["user_id"], ["app_user.id"], name=op.f("fk_second_factor_user_id_app_user"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("user_id", name=op.f("pk_second_factor")),
    )
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )


def downgrade() -> None:
    op.drop_table("second_factor")
