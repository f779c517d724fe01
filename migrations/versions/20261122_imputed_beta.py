"""How many imputed beta amplitudes a state window may hold; none in the settings of before."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("settings_version", sa.Column("most_imputed", sa.SmallInteger(), server_default="0", nullable=False))
    op.create_check_constraint(op.f("ck_settings_version_most_imputed"), "settings_version", "most_imputed >= 0")


def downgrade() -> None:
    op.drop_constraint(op.f("ck_settings_version_most_imputed"), "settings_version", type_="check")
    op.drop_column("settings_version", "most_imputed")
