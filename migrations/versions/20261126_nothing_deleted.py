"""What was entered or measured stays as a row: it is marked as removed, and no confirmed session is ever deleted.

The trail gets the entries that two earlier migrations did not write: of bundle releases that were read from it (0006), and of the settings
of locks (0033). From now on rows are held against it (`betaloop audit verify`).
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0035"
down_revision = "0034"
branch_labels = None
depends_on = None

# table, columns of which only one row that was not removed may have the same, name of the constraint so far, whether nulls are one value
REMOVABLE = (
    ("dose", ["visit_id", "drug", "taken_at"], "uq_dose_visit_id_drug_taken_at", False),
    ("cdbs_amplitude", ["visit_id", "hemisphere", "program"], "uq_cdbs_amplitude_visit_id_hemisphere_program", False),
    ("tremor_series", ["participant_id", "upload_file_id"], "uq_tremor_series_participant_id_upload_file_id", False),
    ("grasp_test", ["session_id", "upload_file_id", "hand"], "uq_grasp_test_session_id_upload_file_id_hand", True),
)
# the row that it hangs on may go (a proposal that was given up, a visit in which nothing was done): table, column, that row's table
OUTLASTS = (("cdbs_amplitude", "visit_id", "visit", None), ("grasp_test", "session_id", "session", "CASCADE"))

KEPT = (
    "create trigger never_deleted before delete on session for each row when (old.status = 'confirmed') execute function refuse_change()"
)

ENTRIES = (
    """
    insert into audit_event (actor, action, entity, entity_id, after, reason)
    select 'migration 0035', 'insert', 'bundle_release', r.id::text, to_jsonb(r),
        'read from the audit trail by migration 0006, which left no entry of the row'
    from bundle_release r where not exists (select from audit_event e where e.entity = 'bundle_release' and e.entity_id = r.id::text)
    order by r.id
    """,
    """
    insert into audit_event (actor, action, entity, entity_id, before, after, reason)
    select 'migration 0035', 'update', 'visit_lock', l.id::text, e.after, to_jsonb(l),
        'the settings in force at the lock, stated by migration 0033, which left no entry of it'
    from visit_lock l cross join lateral (
        select after from audit_event where entity = 'visit_lock' and entity_id = l.id::text order by id desc limit 1
    ) e where l.settings_version_id is not null and not e.after ? 'settings_version_id' order by l.id
    """,
)


def upgrade() -> None:
    for table, columns, constraint, nulls_are_one in REMOVABLE:
        op.add_column(table, sa.Column("removed_at", sa.DateTime(timezone=True), nullable=True))
        op.drop_constraint(constraint, table, type_="unique")
        op.create_index(
            constraint, table, columns, unique=True, postgresql_where=sa.text("removed_at is null"), postgresql_nulls_not_distinct=nulls_are_one
        )
    for table, column, of, _ in OUTLASTS:
        name = f"fk_{table}_{column}_{of}"
        op.alter_column(table, column, nullable=True)
        op.drop_constraint(name, table, type_="foreignkey")
        op.create_foreign_key(name, table, of, [column], ["id"], ondelete="SET NULL")
        op.create_check_constraint(f"ck_{table}_belongs", table, f"{column} is not null or removed_at is not null")
    op.execute(KEPT)
    for entry in ENTRIES:
        op.execute(entry)


def downgrade() -> None:
    """Without what was removed, which earlier versions would count."""
    op.execute("drop trigger never_deleted on session")
    for table, _, _, _ in REMOVABLE:
        op.execute(f"delete from {table} where removed_at is not null")
    for table, column, of, ondelete in OUTLASTS:
        name = f"fk_{table}_{column}_{of}"
        op.drop_constraint(f"ck_{table}_belongs", table, type_="check")
        op.drop_constraint(name, table, type_="foreignkey")
        op.alter_column(table, column, nullable=False)
        op.create_foreign_key(name, table, of, [column], ["id"], ondelete=ondelete)
    for table, columns, constraint, nulls_are_one in REMOVABLE:
        op.drop_index(constraint, table)
        op.create_unique_constraint(constraint, table, columns, postgresql_nulls_not_distinct=nulls_are_one)
        op.drop_column(table, "removed_at")
