"""Sign-on at an identity provider: who a user is there, and what of a browser session came from it."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0030"
down_revision = "0029"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the table of this revision: table, primary key, columns left out
AUDITED = (("sign_on_link", "id", ""),)


def upgrade() -> None:
    op.create_table(
        "sign_on_link",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("issuer", sa.String(500), nullable=False),
        sa.Column("subject", sa.String(255), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.ForeignKeyConstraint(["user_id"], ["app_user.id"], name=op.f("fk_sign_on_link_user_id_app_user"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_sign_on_link")),
        sa.UniqueConstraint("issuer", "subject", name=op.f("uq_sign_on_link_issuer_subject")),
        sa.UniqueConstraint("user_id", "issuer", name=op.f("uq_sign_on_link_user_id_issuer")),
    )
    op.add_column("sign_in", sa.Column("issuer", sa.String(500), nullable=True))
    op.add_column("sign_in", sa.Column("confirmed_at", sa.DateTime(timezone=True), nullable=True))
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )


def downgrade() -> None:
    op.drop_column("sign_in", "confirmed_at")
    op.drop_column("sign_in", "issuer")
    op.drop_table("sign_on_link")
