"""API tokens have a scope and an end; those of before keep all rights of their users, without an end."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("api_token", sa.Column("scope", sa.String(length=10), server_default="full", nullable=False))
    op.add_column("api_token", sa.Column("expires_at", sa.DateTime(timezone=True), nullable=True))
    op.create_check_constraint(op.f("ck_api_token_scope"), "api_token", "scope in ('full', 'read', 'upload', 'jobs')")


def downgrade() -> None:
    op.drop_constraint(op.f("ck_api_token_scope"), "api_token")
    op.drop_column("api_token", "expires_at")
    op.drop_column("api_token", "scope")
