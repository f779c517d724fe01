"""study: the program whose amplitude the controller of a session set, where its recording has several"""

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None


def upgrade() -> None:
    # null in sessions of before: the first program counts there, as it did
    op.add_column("session", sa.Column("control_program", sa.SmallInteger(), nullable=True))
    op.create_check_constraint(op.f("ck_session_control_program"), "session", "control_program between 0 and 15")


def downgrade() -> None:
    op.drop_column("session", "control_program")
