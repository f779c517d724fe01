"""Rights of the service's database role: it owns nothing, writes the audit trail through triggers alone, and deletes from a few tables.

Every migration runs `grant` as the owner of the tables; the doctor asks `excess`. With the service's password one cannot switch a trigger
off, change the trail, or drop or empty a table. Nor can one delete a row of clinical data that the service itself never deletes.
"""

from __future__ import annotations

import getpass

from sqlalchemy import Connection, make_url, text

READ, INSERT, UPDATE, DELETE = "SELECT", "INSERT", "UPDATE", "DELETE"

KEPT: dict[str, frozenset[str]] = {
    "audit_event": frozenset({READ}),
    "audit_link": frozenset({READ}),
    "audit_seal": frozenset({READ, INSERT}),
    "alembic_version": frozenset({READ}),
    "dbos_migrations": frozenset({READ}),
}
"""Tables with fewer rights than others. Seals carry a keyed hash, so that a forged one is seen."""

DELETED_FROM = frozenset(
    {
        "counted_time",
        "membership",
        "plan",
        "plan_item",
        "second_factor",
        "session",
        "session_segment",
        "sign_in_attempt",
        "sign_on_link",
        "stored_file",
        "upload_file",
        "visit",
        "worker",
    }
)
"""Tables of which the service deletes rows: proposals, drafts of plans, planned visits in which nothing was done, and its own upkeep. A
trigger refuses to delete a confirmed session. Rows of audited tables stay in the trail. What was entered or measured is marked as
removed."""

ENGINE_SCHEMA = "dbos"
SCHEMAS = ("public", ENGINE_SCHEMA)

_TABLES = """
select n.nspname, c.relname, c.relkind::text, coalesce(array_agg(a.privilege_type) filter (where a.grantee = r.oid), '{}')
from pg_class c join pg_namespace n on n.oid = c.relnamespace cross join pg_roles r left join lateral aclexplode(c.relacl) a on true
where r.rolname = :role and c.relowner <> r.oid and n.nspname = any(:schemas) and c.relkind in ('r', 'p', 'v', 'S')
group by 1, 2, 3 order by 1, 2
"""
# who may make a trigger of such a function, if only on a temporary table, writes what it likes into the trail
_WRITERS = """
select p.oid::regprocedure::text from pg_proc p join pg_namespace n on n.oid = p.pronamespace cross join pg_roles r
where r.rolname = :role and p.proowner <> r.oid and n.nspname = 'public' and p.prosecdef and p.prorettype = 'trigger'::regtype
and has_function_privilege(r.oid, p.oid, 'EXECUTE') order by 1
"""


def role_of(url: str) -> str:
    """Return the role of a database URL; the name of the system's user where it names none."""
    return make_url(url).username or getpass.getuser()


def wanted(schema: str, table: str) -> frozenset[str]:
    """List the rights of the service's role on a table."""
    if table in KEPT:
        return KEPT[table]
    deletes = schema == ENGINE_SCHEMA or table in DELETED_FROM
    return frozenset({READ, INSERT, UPDATE} | ({DELETE} if deletes else set()))


def grant(connection: Connection, role: str, password: str | None) -> int:
    """Give the role exactly its rights, and make it where it is missing and the owner may. Returns on how many relations they changed.

    What the role itself owns is left alone: the triggers that write the trail run with the owner's rights. `excess` reports it.

    Raises:
        RuntimeError: there is no such role and the owner may not make it.
    """
    _ensure_role(connection, role, password)
    name = _quote(connection, role)
    changed = 0
    for schema, relation, kind, has in connection.execute(text(_TABLES), {"role": role, "schemas": list(SCHEMAS)}).all():
        rights = frozenset({"SELECT", "USAGE"}) if kind == "S" else wanted(schema, relation)
        if frozenset(has) == rights:
            continue
        target = f"{'sequence' if kind == 'S' else 'table'} {_quote(connection, schema)}.{_quote(connection, relation)}"
        connection.exec_driver_sql(f"revoke all on {target} from {name}, public")
        connection.exec_driver_sql(f"grant {', '.join(sorted(rights))} on {target} to {name}")
        changed += 1
    for function in connection.scalars(text(_WRITERS), {"role": role}).all():
        connection.exec_driver_sql(f"revoke execute on function {function} from {name}, public")
    if changed:
        database = _quote(connection, str(connection.scalar(text("select current_database()"))))
        connection.exec_driver_sql(f"grant connect on database {database} to {name}")
        connection.exec_driver_sql(f"revoke temporary on database {database} from public")
        for schema in SCHEMAS:
            connection.exec_driver_sql(f"grant usage on schema {_quote(connection, schema)} to {name}")
            connection.exec_driver_sql(f"revoke create on schema {_quote(connection, schema)} from {name}, public")
    return changed


def excess(connection: Connection) -> list[str]:
    """List what the role of this connection may do beyond its rights, each in words; empty where all is well."""
    found = []
    powers = connection.execute(
        text("select rolsuper, rolcreaterole, rolcreatedb, rolbypassrls, rolreplication from pg_roles where rolname = current_user")
    ).one()
    names = ("is a superuser", "may make roles", "may make databases", "passes row security", "may replicate")
    found += [name for name, has in zip(names, powers, strict=True) if has]
    owned = connection.scalar(
        text(
            "select count(*) from pg_class c join pg_namespace n on n.oid = c.relnamespace"
            " where n.nspname = any(:schemas) and c.relkind in ('r', 'p', 'v', 'S') and pg_has_role(c.relowner, 'member')"
        ),
        {"schemas": list(SCHEMAS)},
    )
    if owned:
        found.append(f"owns {owned} tables and sequences, or may become their owner")
    rights = text(
        "select has_table_privilege(c.oid, 'INSERT, UPDATE, DELETE, TRUNCATE') from pg_class c where c.oid = to_regclass('audit_event')"
    )
    if connection.scalar(rights):
        found.append("may change the audit trail")
    return found


def _ensure_role(connection: Connection, role: str, password: str | None) -> None:
    if connection.scalar(text("select 1 from pg_roles where rolname = :role"), {"role": role}) is not None:
        return
    may = connection.scalar(text("select rolsuper or rolcreaterole from pg_roles where rolname = current_user"))
    if not may:
        raise RuntimeError(f"There is no database role {role}. Have it made: create role {role} login password '...';")
    secret = "" if password is None else f" password {_literal(connection, password)}".replace("%", "%%")
    connection.exec_driver_sql(f"create role {_quote(connection, role)} login{secret}")


def _quote(connection: Connection, name: str) -> str:
    return connection.dialect.identifier_preparer.quote_identifier(name)


def _literal(connection: Connection, value: str) -> str:
    return str(connection.scalar(text("select quote_literal(:value)"), {"value": value}))
