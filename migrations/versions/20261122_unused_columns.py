"""Drop columns that were written and never read.

Reports stand with each file of an upload, the visit that a sender stated in `upload.stated`, and the side with each recording of a device.
"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.drop_column("upload", "report")
    op.drop_column("upload", "visit_id")
    op.drop_column("device", "hemisphere")


def downgrade() -> None:
    op.add_column("device", sa.Column("hemisphere", sa.String(length=5), nullable=True))
    op.create_check_constraint(op.f("ck_device_hemisphere"), "device", "hemisphere in ('left', 'right')")
    op.add_column("upload", sa.Column("visit_id", sa.Integer(), nullable=True))
    op.create_foreign_key(op.f("fk_upload_visit_id_visit"), "upload", "visit", ["visit_id"], ["id"])
    op.create_index(op.f("ix_upload_visit_id"), "upload", ["visit_id"])
    op.add_column("upload", sa.Column("report", postgresql.JSONB(), server_default="[]", nullable=False))
