"""What a plan records of the verdict on its policies: lowest amplitude of a test with care, reason why an unsafe policy is planned."""

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("plan_item", sa.Column("verdict", sa.String(length=20), nullable=True))
    op.add_column("plan_item", sa.Column("min_fraction", sa.Float(), nullable=True))
    op.add_column("plan_item", sa.Column("override_reason", sa.Text(), nullable=True))
    op.create_check_constraint(op.f("ck_plan_item_min_fraction"), "plan_item", "min_fraction > 0 and min_fraction <= 1")
    op.create_check_constraint(op.f("ck_plan_item_override_reason"), "plan_item", "override_reason is null or override_reason <> ''")


def downgrade() -> None:
    op.drop_constraint(op.f("ck_plan_item_override_reason"), "plan_item", type_="check")
    op.drop_constraint(op.f("ck_plan_item_min_fraction"), "plan_item", type_="check")
    op.drop_column("plan_item", "override_reason")
    op.drop_column("plan_item", "min_fraction")
    op.drop_column("plan_item", "verdict")
