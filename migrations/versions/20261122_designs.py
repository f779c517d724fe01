"""Designs of exploration: a setting, which stays the paper's where there was no choice, and what each planned random session shall try."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("settings_version", sa.Column("design", sa.String(length=20), server_default="paper", nullable=False))
    op.add_column("settings_version", sa.Column("design_ladder", sa.Boolean(), server_default="false", nullable=False))
    op.add_column("settings_version", sa.Column("early_visits", sa.SmallInteger(), server_default="3", nullable=False))
    op.create_check_constraint(op.f("ck_settings_version_design"), "settings_version", "design in ('stratified', 'paper')")
    op.create_check_constraint(op.f("ck_settings_version_early_visits"), "settings_version", "early_visits >= 1")
    op.add_column("plan_item", sa.Column("design", postgresql.JSONB(astext_type=sa.Text(), none_as_null=True), nullable=True))


def downgrade() -> None:
    """Without designs: sessions that were held by one keep it in their conditions."""
    op.drop_column("plan_item", "design")
    op.drop_constraint(op.f("ck_settings_version_early_visits"), "settings_version", type_="check")
    op.drop_constraint(op.f("ck_settings_version_design"), "settings_version", type_="check")
    for name in ("early_visits", "design_ladder", "design"):
        op.drop_column("settings_version", name)
