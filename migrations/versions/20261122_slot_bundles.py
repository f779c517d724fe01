"""planning: a bundle may be for one session of a plan, and hold a schedule instead of a policy"""

import sqlalchemy as sa
from alembic import op

revision = "0021"
down_revision = "0020"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("bundle_release", sa.Column("plan_item_id", sa.Integer(), nullable=True))
    op.create_foreign_key(op.f("fk_bundle_release_plan_item_id_plan_item"), "bundle_release", "plan_item", ["plan_item_id"], ["id"])
    op.create_index(op.f("ix_bundle_release_plan_item_id"), "bundle_release", ["plan_item_id"])
    op.alter_column("bundle_release", "policy_id", nullable=True)
    op.create_check_constraint(op.f("ck_bundle_release_what"), "bundle_release", "policy_id is not null or plan_item_id is not null")


def downgrade() -> None:
    op.drop_constraint(op.f("ck_bundle_release_what"), "bundle_release", type_="check")
    op.alter_column("bundle_release", "policy_id", nullable=False)
    op.drop_index(op.f("ix_bundle_release_plan_item_id"), table_name="bundle_release")
    op.drop_column("bundle_release", "plan_item_id")
