"""A locked visit goes by the settings that were in force at its lock: which version that was stands with the lock."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0033"
down_revision = "0032"
branch_labels = None
depends_on = None

COLUMN, KEY = "settings_version_id", "fk_visit_lock_settings_version_id_settings_version"
IN_FORCE = """
update visit_lock l set settings_version_id = (
    select s.id from settings_version s join visit v on v.participant_id = s.participant_id
    where v.id = l.visit_id order by s.created_at > l.created_at, case when s.created_at <= l.created_at then -s.version else s.version end
    limit 1
) where l.locked
"""
"""The newest version from before the lock; where there is none, the oldest."""


def upgrade() -> None:
    op.add_column("visit_lock", sa.Column(COLUMN, sa.Integer(), nullable=True))
    op.create_foreign_key(op.f(KEY), "visit_lock", "settings_version", [COLUMN], ["id"])
    op.execute("alter table visit_lock disable trigger user")  # the rows are never changed; this is what they meant
    op.execute(IN_FORCE)
    op.execute("alter table visit_lock enable trigger user")


def downgrade() -> None:
    op.drop_constraint(op.f(KEY), "visit_lock", type_="foreignkey")
    op.drop_column("visit_lock", COLUMN)
