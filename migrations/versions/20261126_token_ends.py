"""Every API token has an end: those of the first release, which had none, end 90 days from now."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0034"
down_revision = "0033"
branch_labels = None
depends_on = None

REASON = "tokens have an end; one without ends 90 days from this upgrade"


def upgrade() -> None:
    op.execute(f"select set_config('betaloop.reason', '{REASON}', true)")  # for the audit trail, which has each of these changes
    op.execute("update api_token set expires_at = now() + interval '90 days' where expires_at is null")
    op.execute("select set_config('betaloop.reason', '', true)")
    op.alter_column("api_token", "expires_at", existing_type=sa.DateTime(timezone=True), nullable=False)


def downgrade() -> None:
    """Ends stay: a token that was given one does not come back to life for ever."""
    op.alter_column("api_token", "expires_at", existing_type=sa.DateTime(timezone=True), nullable=True)
