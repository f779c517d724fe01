"""Roles of monitors and coordinators."""

from __future__ import annotations

from alembic import op

revision = "0022"
down_revision = "0021"
branch_labels = None
depends_on = None

EARLIER = "role in ('blinded_assessor', 'viewer', 'clinician', 'engineer', 'admin')"
ROLES = "role in ('blinded_assessor', 'viewer', 'monitor', 'coordinator', 'clinician', 'engineer', 'admin')"


def upgrade() -> None:
    op.drop_constraint(op.f("ck_membership_role"), "membership", type_="check")
    op.create_check_constraint(op.f("ck_membership_role"), "membership", ROLES)


def downgrade() -> None:
    op.drop_constraint(op.f("ck_membership_role"), "membership", type_="check")
    op.create_check_constraint(op.f("ck_membership_role"), "membership", EARLIER)
