"""Whether a participant's rankings take the shape of an outcome's answer to the dose from the site's other participants too."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0039"
down_revision = "0038"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("settings_version", sa.Column("pool_shapes", sa.Boolean(), server_default="false", nullable=False))


def downgrade() -> None:
    op.drop_column("settings_version", "pool_shapes")
