"""Ends of studies and sites, prefixes of participants' codes, and what a bundle that left holds."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0036"
down_revision = "0035"
branch_labels = None
depends_on = None


def upgrade() -> None:
    for table in ("study", "site"):
        op.add_column(table, sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column("study", sa.Column("code_prefix", sa.String(length=20), nullable=True))
    op.create_index("uq_study_code_prefix_lower", "study", [sa.text("lower(code_prefix)")], unique=True)
    op.add_column("bundle_release", sa.Column("content_sha256", sa.String(length=64), nullable=True))
    op.create_index(op.f("ix_bundle_release_content_sha256"), "bundle_release", ["content_sha256"])


def downgrade() -> None:
    op.drop_index(op.f("ix_bundle_release_content_sha256"), table_name="bundle_release")
    op.drop_column("bundle_release", "content_sha256")
    op.drop_index("uq_study_code_prefix_lower", table_name="study")
    op.drop_column("study", "code_prefix")
    for table in ("site", "study"):
        op.drop_column(table, "ended_at")
