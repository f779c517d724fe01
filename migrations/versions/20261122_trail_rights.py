"""The triggers of the audit trail write as the owner of the tables, so that the service's role needs no right to write it.

What changed no row reaches the trail through `audit_note`, which takes the actor from the transaction and no action of a trigger.
"""

from __future__ import annotations

from alembic import op

revision = "0023"
down_revision = "0022"
branch_labels = None
depends_on = None

WRITERS = ("audit_row()", "audit_chain()")

NOTE = """
create function audit_note(what text, of_entity text, of_id text, details jsonb) returns void language plpgsql
security definer set search_path = pg_catalog, public, pg_temp as $$
begin
    if what in ('insert', 'update', 'delete') then
        raise exception 'changes of rows are written by triggers alone' using errcode = 'insufficient_privilege';
    end if;
    insert into audit_event (actor, user_id, request_id, action, entity, entity_id, after, reason)
    values (
        coalesce(nullif(current_setting('betaloop.actor', true), ''), session_user),
        nullif(current_setting('betaloop.user_id', true), '')::int,
        nullif(current_setting('betaloop.request_id', true), ''),
        what, of_entity, of_id, details,
        nullif(current_setting('betaloop.reason', true), '')
    );
end $$
"""


def upgrade() -> None:
    for function in WRITERS:
        # the search path is fixed: what runs with the owner's rights must find the owner's tables
        op.execute(f"alter function {function} security definer set search_path = pg_catalog, public, pg_temp")
    op.execute(NOTE)


def downgrade() -> None:
    op.execute("drop function audit_note(text, text, text, jsonb)")
    for function in WRITERS:
        op.execute(f"alter function {function} security invoker reset search_path")
