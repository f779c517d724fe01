"""Guards of the trail: checks that what writes it is what betaloop made. They compare functions by their source and triggers by all that
they do, and find others. They also check the defaults of columns in the trail and in signatures, among them the times.

The owner of the tables could replace a function by one that writes nothing, or add a trigger before it that lets nothing through.
Migrations define both. Their definitions are repeated here, and a test compares the two.

A write with the triggers off leaves a difference between a row and its newest entry of the trail. Columns that the trail omits (secrets,
bulk arrays, live progress) are not compared. A column that a later version added is not in an older entry. The row must then have what that
version gave to every row, where the database still records it. Else the column is not compared until the row's next entry.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence

from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform.audit.breaks import MOST_BREAKS, Break, BreakKind
from app.platform.audit.trail import AUDITED

_AS_OWNER = ("search_path=pg_catalog, public, pg_temp",)
FUNCTIONS: dict[str, tuple[str, tuple[str, ...] | None]] = {
    "audit_row()": ("3be7f5ea05740bef04bf16c907db91f46874b53ea394538af5689bcbc10e7c21", _AS_OWNER),
    "audit_chain()": ("310aa78f4ccefa3f2bff46c1e7f9dd9ea7b1056735a6adc4a212d960c3ea15c6", _AS_OWNER),
    "audit_digest(bytea,audit_event)": ("2cb7199a5193e7d7854e3c7c75808f9765fd36b3c637c12d0162727e4a485b45", None),
    "audit_field(text)": ("2d5a3e0a662df07283731d2de9968e470861aabc939ce9ee87c08d2e96ec016a", None),
    "audit_note(text,text,text,jsonb)": ("ec4263b5a33410d9f815c47eee1d734788d26f93ca2c0b1dc8f39b8a8b7dcab5", _AS_OWNER),
    "refuse_change()": ("da93516501980e79942450e1be880906bbc4364c29d70d72b2961d3d3f533966", None),
}
"""What the trail rests on: SHA-256 of the source as the newest migration left it, and its settings; those with settings run as owner."""

NEVER_CHANGED = ("audit_event", "audit_link", "audit_seal")

_EACH_WRITE, _EACH_INSERT, _BEFORE_CHANGE, _BEFORE_DELETION, _BEFORE_TRUNCATE = 29, 5, 27, 11, 34  # pg_trigger.tgtype
KNOWN = {
    ("audit", "audit_row", _EACH_WRITE),
    ("chained", "audit_chain", _EACH_INSERT),
    ("never_changed", "refuse_change", _BEFORE_CHANGE),
    ("never_emptied", "refuse_change", _BEFORE_TRUNCATE),
    ("never_deleted", "refuse_change", _BEFORE_DELETION),
    ("enrolled_as", "refuse_change", 19),
    ("count_time", "count_time_of_recording", 17),
    ("count_time", "count_time_of_session", 17),
    ("count_time", "count_time_of_segment", _EACH_WRITE),
}
"""Every trigger that migrations give to an audited table or to the trail: name, function, and when it runs."""
WHEN = {
    "never_deleted": "(((old.status)::text = 'confirmed'::text))",
    "enrolled_as": "((old.synthetic IS DISTINCT FROM new.synthetic))",
}
"""On what a trigger depends; the others on nothing."""

_FUNCTIONS = """
select p.oid::regprocedure::text, p.prosrc, p.prosecdef, p.proconfig from pg_proc p where p.pronamespace = 'public'::regnamespace
"""
_TRIGGERS = """
select c.relname, t.tgname, p.proname, t.tgtype::int, p.pronamespace = 'public'::regnamespace, t.tgenabled::text,
    coalesce(substring(pg_get_triggerdef(t.oid) from ' WHEN (.*) EXECUTE '), ''), t.tgattr::text, encode(t.tgargs, 'escape')
from pg_trigger t join pg_class c on c.oid = t.tgrelid join pg_proc p on p.oid = t.tgfoid
where not t.tgisinternal and c.relnamespace = 'public'::regnamespace
union all
select c.relname, r.rulename, '', 0, false, '', '', '', '' from pg_rewrite r join pg_class c on c.oid = r.ev_class
where c.relnamespace = 'public'::regnamespace and c.relkind = 'r'
"""
DEFAULTS = {
    ("audit_event", "id"): "nextval('audit_event_id_seq'::regclass)",
    ("audit_event", "at"): "clock_timestamp()",
    ("audit_seal", "made_at"): "clock_timestamp()",
    ("signature", "id"): "nextval('signature_id_seq'::regclass)",
    ("signature", "signed_at"): "clock_timestamp()",
}
"""By table and column; the other columns of these tables and of the chain have none."""
_DEFAULTS = """
select c.relname, a.attname, pg_get_expr(d.adbin, d.adrelid),
    exists (select from pg_depend p where p.classid = 'pg_attrdef'::regclass and p.objid = d.oid and p.refclassid = 'pg_proc'::regclass)
from pg_attrdef d join pg_class c on c.oid = d.adrelid join pg_attribute a on a.attrelid = c.oid and a.attnum = d.adnum
where c.relnamespace = 'public'::regnamespace and c.relname = any(:tables)
"""  # functions of PostgreSQL itself leave no dependency: one that is found is somebody's, whatever its name
_KEYS = """
select c.relname, string_agg(a.attname, ',' order by k.place)
from pg_index i join pg_class c on c.oid = i.indrelid cross join lateral unnest(i.indkey::int2[]) with ordinality k(number, place)
join pg_attribute a on a.attrelid = c.oid and a.attnum = k.number
where i.indisprimary and c.relnamespace = 'public'::regnamespace group by 1
"""


def keys(db: Session) -> dict[str, tuple[str, ...]]:
    """List the columns of each table's primary key, in order."""
    return {table: tuple(columns.split(",")) for table, columns in db.execute(text(_KEYS))}


def what_writes(db: Session) -> list[Break]:
    """Check what writes the trail: functions, triggers, rules and defaults that are missing, off, changed or not betaloop's."""
    return [*_functions(db), *_triggers(db), *_defaults(db)]


def _functions(db: Session) -> Iterator[Break]:
    there = {name: (source, as_owner, settings) for name, source, as_owner, settings in db.execute(text(_FUNCTIONS))}
    for name, (sha256, wanted) in FUNCTIONS.items():
        source, as_owner, settings = there.get(name, ("", False, None))
        same = hashlib.sha256(source.encode()).hexdigest() == sha256
        if not same or as_owner != (wanted is not None) or settings != (list(wanted) if wanted else None):
            yield Break(BreakKind.FUNCTION_CHANGED, name=name)


def _defaults(db: Session) -> Iterator[Break]:
    """Find columns of the trail and of signatures with another default value: a false time, or another person's name."""
    rows = db.execute(text(_DEFAULTS), {"tables": [*NEVER_CHANGED, "signature"]})
    there = {(table, column): None if of_others else expression for table, column, expression, of_others in rows}
    for table, column in sorted(there.keys() | DEFAULTS.keys()):
        if there.get((table, column)) != DEFAULTS.get((table, column), ""):
            yield Break(BreakKind.DEFAULT_CHANGED, table=table, columns=(column,))


def _triggers(db: Session) -> Iterator[Break]:
    """Find triggers whose changes would not reach the trail or the chain, or that would let it be changed, and foreign ones."""
    arguments = {
        table: "".join(f"{part}\\000" for part in (",".join(AUDITED[table]), ",".join(key)))
        for table, key in keys(db).items()
        if table in AUDITED
    }
    wanted = {(table, "audit") for table in AUDITED}
    wanted |= {(table, name) for table in NEVER_CHANGED for name in ("never_changed", "never_emptied")}
    wanted |= {("audit_event", "chained"), ("session", "never_deleted"), ("participant", "enrolled_as")}
    good = set()
    for table, name, function, moment, own, enabled, condition, columns, given in db.execute(text(_TRIGGERS)):
        if table not in AUDITED and table not in NEVER_CHANGED:
            continue
        if not (own and (name, function, moment) in KNOWN):
            yield Break(BreakKind.TRIGGER_UNKNOWN, table=table, name=name)
            continue
        as_made = (columns, condition) == ("", WHEN.get(name, "")) and (name != "audit" or given == arguments.get(table))
        if as_made and enabled in ("O", "A"):
            good.add((table, name))
    for table, name in sorted(wanted - good):
        yield Break(BreakKind.TRIGGER_OFF, table=table, name=name)


# Comparison of the audited tables with the trail: a write past the trail, with its triggers off, leaves a difference.
#
# Each row is compared with its newest entry of the trail. Columns that the trail omits (secrets, bulk arrays, live progress) are not
# compared. A column that a later version added is not in an older entry. The row must then have what that version gave to every row,
# where the database still records it. Else the column is not compared until the row's next entry.

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
    select distinct on (row_key) row_key, id, after from (
        select entity_id as row_key, id, after from audit_event where entity = '{table}' and action in ('insert', 'update', 'delete')
        union all
        select {before_key}, id, null from audit_event where entity = '{table}' and action = 'update' and {before_key} <> entity_id
    ) entries order by row_key, id desc
), present as (
    select {key} as row_key, {columns} from {table} t
)
select coalesce(e.row_key, r.row_key), e.id, r.row_key is not null, array_remove(array[{differing}]::text[], null)
from (select * from told where after is not null) e full join present r on r.row_key = e.row_key
left join lateral jsonb_populate_record(null::{table}, e.after) p on true
where e.row_key is null or r.row_key is null or {any_differs} order by e.id, 1 limit {most}
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
