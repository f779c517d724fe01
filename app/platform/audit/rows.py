"""Comparison of the audited tables with the trail: a write past the trail, with its triggers off, leaves a difference.

Each row is compared with its newest entry of the trail. Columns that the trail omits (secrets, bulk arrays, live progress) are not
compared. A column that a later version added is not in an older entry. The row must then have what that version gave to every row, where
the database still records it. Else the column is not compared until the row's next entry.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform.audit.breaks import MOST_BREAKS, Break, BreakKind
from app.platform.audit.guards import keys
from app.platform.audit.trail import AUDITED

QUIET = ("last_seen_at", "last_used_at", "progress", "message", "updated_at")
"""Columns of any table whose change alone writes no entry (`audit_row` of the first migration)."""

_COLUMNS = """
select c.relname, a.attname, t.typname, case when a.atthasmissing then 'given' when a.attnotnull or a.atthasdef then '' else 'null' end
from pg_attribute a join pg_class c on c.oid = a.attrelid join pg_type t on t.oid = a.atttypid
where c.relnamespace = 'public'::regnamespace and c.relkind = 'r' and a.attnum > 0 and not a.attisdropped order by 1, a.attnum
"""
# A row whose key was changed has a last entry under its former key too, which records that it is gone from there. Entries are read as the
# table's own types, so that neither zone nor spelling counts.
_DIFFERENCES = """
with told as (
    select distinct on (key) key, id, after from (
        select entity_id as key, id, after from audit_event where entity = '{table}' and action in ('insert', 'update', 'delete')
        union all
        select {before_key}, id, null from audit_event where entity = '{table}' and action = 'update' and {before_key} <> entity_id
    ) entries order by key, id desc
), present as (
    select {key} as key, {columns} from {table} t
)
select coalesce(e.key, r.key), e.id, r.key is not null, array_remove(array[{differing}]::text[], null)
from (select * from told where after is not null) e full join present r on r.key = e.key
left join lateral jsonb_populate_record(null::{table}, e.after) p on true
where e.key is null or r.key is null or {any_differs} order by e.id, 1 limit {most}
"""
_GIVEN = "(select (attmissingval::text::text[])[1] from pg_attribute where attrelid = '{table}'::regclass and attname = '{column}')"


def past_the_trail(db: Session) -> Iterator[Break]:
    """Find rows that were altered, removed or inserted without an entry of the trail, table by table; of each table at most MOST_BREAKS."""
    key_of: dict[str, tuple[str, ...]] = keys(db)
    columns_of: dict[str, dict[str, tuple[str, str]]] = {}
    for table, column, kind, first in db.execute(text(_COLUMNS)):
        columns_of.setdefault(table, {})[column] = kind, first
    for table, hidden in AUDITED.items():
        compared = {column: how for column, how in columns_of[table].items() if column not in {*hidden, *QUIET}}
        for row, event_id, there, columns in db.execute(text(_differences(table, key_of[table], compared))):
            kind = BreakKind.ROW_ADDED if event_id is None else BreakKind.ROW_ALTERED if there else BreakKind.ROW_REMOVED
            yield Break(kind, event_id=event_id, table=table, row=row, columns=tuple(columns) if kind is BreakKind.ROW_ALTERED else ())


def _differences(table: str, key: Sequence[str], compared: dict[str, tuple[str, str]]) -> str:
    """Write the query of a table, names as in the schema. Each column has its type, and what older rows have: `given` or `null`."""

    def side(alias: str, column: str) -> str:
        value = f'{alias}."{column}"'
        return f"nullif({value}, 'null')" if compared[column][0] == "jsonb" else value  # JSON's null and the database's are one in an entry

    def not_as_added(column: str) -> str:
        kind, first = compared[column]
        given = _GIVEN.format(table=table, column=column)
        return {"given": f'r."{column}" is distinct from {given}::{kind}', "null": f'r."{column}" is not null'}.get(first, "false")

    differ = {
        c: f"(case when e.after ? '{c}' then {side('r', c)} is distinct from {side('p', c)} else {not_as_added(c)} end)" for c in compared
    }
    return _DIFFERENCES.format(
        table=table,
        key=" || '/' || ".join(f"(to_jsonb(t.\"{c}\") #>> '{{}}')" for c in key),
        before_key=" || '/' || ".join(f"(before ->> '{c}')" for c in key),
        columns=", ".join(f't."{c}"' for c in compared),
        differing=", ".join(f"case when {differs} then '{c}' end" for c, differs in differ.items()),
        any_differs=" or ".join(differ.values()),
        most=MOST_BREAKS,
    )
