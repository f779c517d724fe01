"""Columns that were written and never read: a file's media type, and who cancelled a job, which its event says."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0031"
down_revision = "0030"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.drop_column("stored_file", "media_type")
    op.drop_column("job", "cancel_requested_by")


def downgrade() -> None:
    op.add_column("job", sa.Column("cancel_requested_by", sa.String(254), nullable=True))
    op.add_column("stored_file", sa.Column("media_type", sa.String(100), nullable=False, server_default="application/octet-stream"))
    op.alter_column("stored_file", "media_type", server_default=None)
