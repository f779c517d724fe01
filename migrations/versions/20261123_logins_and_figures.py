"""A login at the provider counts once: when the newest one was made that a user has shown. Tokens for the service's figures alone."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0032"
down_revision = "0031"
branch_labels = None
depends_on = None

TRIGGER = "create trigger audit after insert or update or delete on sign_on_link for each row execute function audit_row('{}', 'id')"
SCOPES = "scope in ('full', 'read', 'upload', 'jobs'{})"


def upgrade() -> None:
    op.add_column("sign_on_link", sa.Column("last_used_at", sa.DateTime(timezone=True), nullable=True))
    _audit(hidden="last_used_at")
    _scopes(", 'metrics'")


def downgrade() -> None:
    op.execute("update api_token set revoked_at = now(), scope = 'read' where scope = 'metrics'")
    _scopes("")
    _audit(hidden="")
    op.drop_column("sign_on_link", "last_used_at")


def _audit(hidden: str) -> None:
    op.execute("drop trigger audit on sign_on_link")
    op.execute(TRIGGER.format(hidden))


def _scopes(more: str) -> None:
    op.drop_constraint(op.f("ck_api_token_scope"), "api_token", type_="check")
    op.create_check_constraint(op.f("ck_api_token_scope"), "api_token", SCOPES.format(more))
