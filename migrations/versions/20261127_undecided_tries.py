"""A try to sign in is undecided until its verdict is written; those that are there failed, and so does one of which nothing is said."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0040"
down_revision = "0039"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("sign_in_attempt", sa.Column("failed", sa.Boolean(), server_default=sa.text("true"), nullable=False))


def downgrade() -> None:
    """Undecided tries count as failed, as they did before."""
    op.drop_column("sign_in_attempt", "failed")
