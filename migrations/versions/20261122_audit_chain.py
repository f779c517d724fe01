"""The audit trail is chained: every row has a link with a hash over the link before it."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None

# each field with its length, so that no two rows give the same bytes; app.platform.audit.chain computes the same
FIELD = """
create function audit_field(value text) returns bytea language sql immutable parallel safe as $$
    select case when value is null then int4send(-1) else int4send(octet_length(convert_to(value, 'UTF8'))) || convert_to(value, 'UTF8') end
$$
"""

DIGEST = """
create function audit_digest(previous bytea, e audit_event) returns bytea language sql immutable parallel safe as $$
    select sha256(
        previous || audit_field(e.id::text) || audit_field((extract(epoch from e.at) * 1000000)::bigint::text)
        || audit_field(e.actor) || audit_field(e.user_id::text) || audit_field(e.request_id) || audit_field(e.action)
        || audit_field(e.entity) || audit_field(e.entity_id) || audit_field(e.before::text) || audit_field(e.after::text)
        || audit_field(e.reason)
    )
$$
"""

# runs when its transaction commits: links have the order of commits, and the lock is held for no longer than a commit takes
LINK = """
create function audit_chain() returns trigger language plpgsql as $$
declare
    last audit_link;
begin
    perform pg_advisory_xact_lock(1635083369);
    select * into last from audit_link order by position desc limit 1;
    insert into audit_link (position, event_id, digest) values (
        coalesce(last.position, 0) + 1, new.id, audit_digest(coalesce(last.digest, sha256('betaloop audit trail')), new)
    );
    return null;
end $$
"""

EARLIER = """
do $$
declare
    e audit_event;
    place bigint := 0;
    last bytea := sha256('betaloop audit trail');
begin
    for e in select * from audit_event order by id loop
        place := place + 1;
        last := audit_digest(last, e);
        insert into audit_link (position, event_id, digest) values (place, e.id, last);
    end loop;
end $$
"""


def upgrade() -> None:
    op.create_table(
        "audit_link",
        sa.Column("position", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("event_id", sa.BigInteger(), nullable=False),
        sa.Column("digest", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("position", name=op.f("pk_audit_link")),
        sa.UniqueConstraint("event_id", name=op.f("uq_audit_link_event_id")),
    )
    op.create_table(
        "audit_seal",
        sa.Column("position", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("digest", sa.LargeBinary(), nullable=False),
        sa.Column("mac", sa.LargeBinary(), nullable=False),
        sa.Column("made_at", sa.DateTime(timezone=True), server_default=sa.text("clock_timestamp()"), nullable=False),
        sa.PrimaryKeyConstraint("position", name=op.f("pk_audit_seal")),
    )
    for statement in (FIELD, DIGEST, LINK, EARLIER):
        op.execute(statement)
    op.execute(
        "create constraint trigger chained after insert on audit_event deferrable initially deferred for each row execute function audit_chain()"
    )
    for table in ("audit_link", "audit_seal"):
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")
        op.execute(f"create trigger never_emptied before truncate on {table} for each statement execute function refuse_change()")


def downgrade() -> None:
    op.execute("drop trigger chained on audit_event")
    op.drop_table("audit_seal")
    op.drop_table("audit_link")
    for function in ("audit_chain()", "audit_digest(bytea, audit_event)", "audit_field(text)"):
        op.execute(f"drop function {function}")
