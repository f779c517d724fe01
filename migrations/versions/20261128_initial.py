"""The schema of the first release: tables, the audit trail's functions and triggers, counted time, and the first study and site."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "first_18b7440f"
down_revision = None
branch_labels = None
depends_on = None

# triggers write the trail as the owner of the tables; the search path is fixed, so that they find the owner's tables alone
AUDIT_ROW = """
create function audit_row() returns trigger language plpgsql
security definer set search_path = pg_catalog, public, pg_temp as $$
declare
    hidden text[] := coalesce(string_to_array(nullif(tg_argv[0], ''), ','), '{}');
    key_columns text[] := string_to_array(tg_argv[1], ',');
    old_row jsonb := case when tg_op = 'INSERT' then null else to_jsonb(old) - hidden end;
    new_row jsonb := case when tg_op = 'DELETE' then null else to_jsonb(new) - hidden end;
    quiet text[] := '{last_seen_at,last_used_at,progress,message,updated_at}';
    key text;
begin
    if tg_op = 'UPDATE' and to_jsonb(old) - quiet = to_jsonb(new) - quiet then
        return null;
    end if;
    select string_agg(coalesce(new_row, old_row) ->> k, '/') into key from unnest(key_columns) as k;
    insert into audit_event (actor, user_id, request_id, action, entity, entity_id, before, after, reason)
    values (
        coalesce(nullif(current_setting('betaloop.actor', true), ''), session_user),
        nullif(current_setting('betaloop.user_id', true), '')::int,
        nullif(current_setting('betaloop.request_id', true), ''),
        lower(tg_op), tg_table_name, key, old_row, new_row,
        nullif(current_setting('betaloop.reason', true), '')
    );
    return null;
end $$
"""

# entries that are no change of a row; their actor comes from the transaction
AUDIT_NOTE = """
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

REFUSE_CHANGE = """
create function refuse_change() returns trigger language plpgsql as $$
begin
    raise exception 'rows of % are never changed or deleted', tg_table_name using errcode = 'restrict_violation';
end $$
"""

# each field with its length, so that no two rows give the same bytes; app.platform.audit.chain computes the same
AUDIT_FIELD = """
create function audit_field(value text) returns bytea language sql immutable parallel safe as $$
    select case when value is null then int4send(-1) else int4send(octet_length(convert_to(value, 'UTF8'))) || convert_to(value, 'UTF8') end
$$
"""

AUDIT_DIGEST = """
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
AUDIT_CHAIN = """
create function audit_chain() returns trigger language plpgsql
security definer set search_path = pg_catalog, public, pg_temp as $$
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

# the minutes of a device and side count once; the constraint is over ranges, since scalars would need an extension of PostgreSQL
COUNT_TIME = (
    """
    create function count_time(which integer) returns void language plpgsql as $$
    begin
      delete from counted_time where session_id = which;
      insert into counted_time (session_id, recording_id, start_s, device_side, span)
        select s.id, r.id, g.start_s,
          case when r.hemisphere is null then int4range(4 * r.device_id, 4 * r.device_id + 4)
               else int4range(4 * r.device_id + (r.hemisphere = 'right')::int, 4 * r.device_id + (r.hemisphere = 'right')::int + 1) end,
          tstzrange(r.started_at + make_interval(secs => g.start_s + 1),
                    r.started_at + make_interval(secs => greatest(g.stop_s - 1, g.start_s + 1)))
        from session s join session_segment g on g.session_id = s.id join recording r on r.id = g.recording_id
        where s.status = 'confirmed' and s.excluded_reason is null and g.is_control and r.started_at is not null and s.id = which;
    end $$
    """,
    """
    create function count_time_of_segment() returns trigger language plpgsql as $$
    begin
      if tg_op <> 'INSERT' then perform count_time(old.session_id); end if;
      if tg_op <> 'DELETE' then perform count_time(new.session_id); end if;
      return null;
    end $$
    """,
    """
    create function count_time_of_session() returns trigger language plpgsql as $$
    begin
      perform count_time(new.id);
      return null;
    end $$
    """,
    """
    create function count_time_of_recording() returns trigger language plpgsql as $$
    begin
      perform count_time(g.session_id) from (select distinct session_id from session_segment where recording_id = new.id) g;
      return null;
    end $$
    """,
)
COUNT_TIME_TRIGGERS = (
    "create trigger count_time after insert or update or delete on session_segment for each row execute function count_time_of_segment()",
    "create trigger count_time after update of status, excluded_reason on session for each row execute function count_time_of_session()",
    "create trigger count_time after update of started_at, hemisphere, device_id on recording"
    " for each row execute function count_time_of_recording()",
)

# frozen copy of app.platform.audit.AUDITED at this revision: table, primary key, columns left out
AUDITED = (
    ("adverse_event", "id", ""),
    ("adverse_event_revision", "id", ""),
    ("api_token", "id", "token_sha256,last_used_at"),
    ("app_user", "id", "password_hash"),
    ("buffer_gate_decision", "id", ""),
    ("buffer_snapshot", "id", ""),
    ("bundle_release", "id", ""),
    ("cdbs_amplitude", "id", ""),
    ("characteristics_version", "id", ""),
    ("column_mapping", "id", ""),
    ("data_query", "id", ""),
    ("data_query_entry", "id", ""),
    ("day_entry", "id", ""),
    ("declared_confirmation", "id", ""),
    ("device", "id", ""),
    ("dose", "id", ""),
    ("estimate", "id", "details"),
    ("evaluation", "id", ""),
    ("grasp_test", "id", "open_fist_s_f64"),
    ("job", "id", "progress,message,updated_at"),
    ("margins_lock", "id", ""),
    ("margins_version", "id", ""),
    ("membership", "id", ""),
    ("participant", "id", ""),
    ("plan", "id", ""),
    ("plan_item", "id", ""),
    ("policy", "id", ""),
    ("port_check", "id", "result"),
    ("qoc", "id", ""),
    ("recording", "id", "details"),
    ("second_factor", "user_id", "sealed_secret,recovery,last_used_at"),
    ("session", "id", ""),
    ("session_conditions", "id", ""),
    ("session_proposal", "session_id", ""),
    ("session_segment", "session_id,recording_id,start_s", ""),
    ("settings_version", "id", ""),
    ("sign_in", "id", "token_sha256,last_seen_at"),
    ("sign_on_link", "id", "last_used_at"),
    ("signal_meaning", "id", ""),
    ("signature", "id", "content"),
    ("site", "id", ""),
    ("snapshot_session", "snapshot_id,session_id", ""),
    ("stored_file", "sha256", ""),
    ("study", "id", ""),
    ("sweep", "id", ""),
    ("trace", "id", "values_f32,valid_bits"),
    ("tremor_series", "id", "start_unix_s_f64,duration_s_f64,fractions_f32,any_tremor_f32"),
    ("upload", "id", "report"),
    ("upload_file", "id", "report"),
    ("visit", "id", ""),
    ("visit_lock", "id", ""),
)

# results rest on these rows, so they stay as they were written
NEVER_CHANGED = (
    "adverse_event",
    "adverse_event_revision",
    "audit_event",
    "audit_link",
    "audit_seal",
    "buffer_gate_decision",
    "buffer_snapshot",
    "bundle_release",
    "characteristics_version",
    "column_mapping",
    "data_query",
    "data_query_entry",
    "day_entry",
    "declared_confirmation",
    "estimate",
    "margins_lock",
    "margins_version",
    "port_check",
    "qoc",
    "session_conditions",
    "settings_version",
    "signal_meaning",
    "signature",
    "snapshot_session",
    "sweep",
    "visit_lock",
)
NEVER_EMPTIED = ("audit_event", "audit_link", "audit_seal")
ENROLLED_AS = (
    "create trigger enrolled_as before update on participant for each row"
    " when (old.synthetic is distinct from new.synthetic) execute function refuse_change()"
)
NEVER_DELETED = (
    "create trigger never_deleted before delete on session for each row when (old.status = 'confirmed') execute function refuse_change()"
)


def upgrade() -> None:
    op.create_table(
        "app_user",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("email", sa.String(length=254), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("password_hash", sa.String(length=300), nullable=False),
        sa.Column("active", sa.Boolean(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("email = lower(email)", name=op.f("ck_app_user_email_lower")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_app_user")),
        sa.UniqueConstraint("email", name=op.f("uq_app_user_email")),
    )
    op.create_table(
        "audit_event",
        sa.Column("id", sa.BigInteger(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), server_default=sa.text("clock_timestamp()"), nullable=False),
        sa.Column("actor", sa.String(length=254), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=True),
        sa.Column("request_id", sa.String(length=64), nullable=True),
        sa.Column("action", sa.String(length=10), nullable=False),
        sa.Column("entity", sa.String(length=63), nullable=False),
        sa.Column("entity_id", sa.String(length=200), nullable=False),
        sa.Column("before", postgresql.JSONB(astext_type=sa.Text()), nullable=True),
        sa.Column("after", postgresql.JSONB(astext_type=sa.Text()), nullable=True),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_audit_event")),
    )
    op.create_index(op.f("ix_audit_event_at"), "audit_event", ["at"], unique=False)
    op.create_index("ix_audit_event_entity", "audit_event", ["entity", "entity_id"], unique=False)
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
    op.create_table(
        "sign_in_attempt",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("email", sa.String(length=254), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("failed", sa.Boolean(), server_default=sa.text("true"), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_sign_in_attempt")),
    )
    op.create_index("ix_sign_in_attempt_email_at", "sign_in_attempt", ["email", "at"], unique=False)
    op.create_table(
        "stored_file",
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("sha256 ~ '^[0-9a-f]{64}$'", name=op.f("ck_stored_file_sha256")),
        sa.CheckConstraint("size >= 0", name=op.f("ck_stored_file_size")),
        sa.PrimaryKeyConstraint("sha256", name=op.f("pk_stored_file")),
    )
    op.create_table(
        "study",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("code", sa.String(length=40), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("code_prefix", sa.String(length=20), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_study")),
        sa.UniqueConstraint("code", name=op.f("uq_study_code")),
    )
    op.create_index("uq_study_code_prefix_lower", "study", [sa.literal_column("lower(code_prefix)")], unique=True)
    op.create_table(
        "worker",
        sa.Column("id", sa.String(length=100), nullable=False),
        sa.Column("host", sa.String(length=255), nullable=False),
        sa.Column("pid", sa.Integer(), nullable=False),
        sa.Column("protocol", sa.Integer(), nullable=False),
        sa.Column("code_version", sa.String(length=80), nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("seen_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_worker")),
    )
    op.create_table(
        "api_token",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("token_sha256", sa.String(length=64), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("last_used_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("revoked_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("scope", sa.String(length=10), server_default="full", nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=False),
        sa.CheckConstraint("scope in ('full', 'read', 'upload', 'jobs', 'metrics')", name=op.f("ck_api_token_scope")),
        sa.ForeignKeyConstraint(["user_id"], ["app_user.id"], name=op.f("fk_api_token_user_id_app_user"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_api_token")),
        sa.UniqueConstraint("token_sha256", name=op.f("uq_api_token_token_sha256")),
        sa.UniqueConstraint("user_id", "name", name=op.f("uq_api_token_user_id_name")),
    )
    op.create_index(op.f("ix_api_token_user_id"), "api_token", ["user_id"], unique=False)
    op.create_table(
        "signal_meaning",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.Integer(), nullable=False),
        sa.Column("key", sa.String(length=80), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("shown", sa.String(length=100), nullable=False),
        sa.Column("meaning", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("removed", sa.Boolean(), server_default="false", nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.CheckConstraint("version >= 1", name=op.f("ck_signal_meaning_version")),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_signal_meaning_study_id_study")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_signal_meaning")),
        sa.UniqueConstraint("study_id", "key", "version", name=op.f("uq_signal_meaning_study_id_key_version")),
    )
    op.create_index(op.f("ix_signal_meaning_study_id"), "signal_meaning", ["study_id"], unique=False)
    op.create_table(
        "column_mapping",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.Integer(), nullable=False),
        sa.Column("header", sa.String(length=64), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("mapping", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("labels", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("removed", sa.Boolean(), server_default="false", nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.CheckConstraint("version >= 1", name=op.f("ck_column_mapping_version")),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_column_mapping_study_id_study")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_column_mapping")),
        sa.UniqueConstraint("study_id", "header", "version", name=op.f("uq_column_mapping_study_id_header_version")),
    )
    op.create_index(op.f("ix_column_mapping_study_id"), "column_mapping", ["study_id"], unique=False)
    op.create_table(
        "second_factor",
        sa.Column("user_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("sealed_secret", sa.LargeBinary(), nullable=False),
        sa.Column("recovery", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("confirmed_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("last_used_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["user_id"], ["app_user.id"], name=op.f("fk_second_factor_user_id_app_user"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("user_id", name=op.f("pk_second_factor")),
    )
    op.create_table(
        "sign_in",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("token_sha256", sa.String(length=64), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("last_seen_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("issuer", sa.String(length=500), nullable=True),
        sa.Column("confirmed_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["user_id"], ["app_user.id"], name=op.f("fk_sign_in_user_id_app_user"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_sign_in")),
        sa.UniqueConstraint("token_sha256", name=op.f("uq_sign_in_token_sha256")),
    )
    op.create_index(op.f("ix_sign_in_user_id"), "sign_in", ["user_id"], unique=False)
    op.create_table(
        "sign_on_link",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("issuer", sa.String(length=500), nullable=False),
        sa.Column("subject", sa.String(length=255), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("last_used_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["user_id"], ["app_user.id"], name=op.f("fk_sign_on_link_user_id_app_user"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_sign_on_link")),
        sa.UniqueConstraint("issuer", "subject", name=op.f("uq_sign_on_link_issuer_subject")),
        sa.UniqueConstraint("user_id", "issuer", name=op.f("uq_sign_on_link_user_id_issuer")),
    )
    op.create_table(
        "signature",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("subject_kind", sa.String(length=40), nullable=False),
        sa.Column("subject_id", sa.Integer(), nullable=False),
        sa.Column("meaning", sa.String(length=200), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("content", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("signed_by", sa.Integer(), nullable=False),
        sa.Column("signer", sa.String(length=254), nullable=False),
        sa.Column("signed_at", sa.DateTime(timezone=True), server_default=sa.text("clock_timestamp()"), nullable=False),
        sa.CheckConstraint("meaning <> '' and subject_kind <> ''", name=op.f("ck_signature_stated")),
        sa.CheckConstraint("sha256 ~ '^[0-9a-f]{64}$'", name=op.f("ck_signature_sha256")),
        sa.ForeignKeyConstraint(["signed_by"], ["app_user.id"], name=op.f("fk_signature_signed_by_app_user")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_signature")),
    )
    op.create_index("ix_signature_subject", "signature", ["subject_kind", "subject_id"], unique=False)
    op.create_table(
        "site",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.Integer(), nullable=False),
        sa.Column("code", sa.String(length=40), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_site_study_id_study")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_site")),
        sa.UniqueConstraint("study_id", "code", name=op.f("uq_site_study_id_code")),
    )
    op.create_table(
        "membership",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.Integer(), nullable=False),
        sa.Column("site_id", sa.Integer(), nullable=True),
        sa.Column("role", sa.String(length=20), nullable=False),
        sa.CheckConstraint(
            "role in ('blinded_assessor', 'viewer', 'monitor', 'coordinator', 'clinician', 'engineer', 'admin')",
            name=op.f("ck_membership_role"),
        ),
        sa.ForeignKeyConstraint(["site_id"], ["site.id"], name=op.f("fk_membership_site_id_site")),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_membership_study_id_study")),
        sa.ForeignKeyConstraint(["user_id"], ["app_user.id"], name=op.f("fk_membership_user_id_app_user"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_membership")),
        sa.UniqueConstraint(
            "user_id", "study_id", "site_id", name=op.f("uq_membership_user_id_study_id_site_id"), postgresql_nulls_not_distinct=True
        ),
    )
    op.create_index(op.f("ix_membership_site_id"), "membership", ["site_id"], unique=False)
    op.create_index(op.f("ix_membership_study_id"), "membership", ["study_id"], unique=False)
    op.create_index(op.f("ix_membership_user_id"), "membership", ["user_id"], unique=False)
    op.create_table(
        "participant",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("site_id", sa.Integer(), nullable=False),
        sa.Column("code", sa.String(length=40), nullable=False),
        sa.Column("status", sa.String(length=20), server_default="active", nullable=False),
        sa.Column("synthetic", sa.Boolean(), server_default="false", nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("status in ('active', 'completed', 'withdrawn')", name=op.f("ck_participant_status")),
        sa.ForeignKeyConstraint(["site_id"], ["site.id"], name=op.f("fk_participant_site_id_site")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_participant")),
        sa.UniqueConstraint("code", name=op.f("uq_participant_code")),
    )
    op.create_index(op.f("ix_participant_site_id"), "participant", ["site_id"], unique=False)
    op.create_index("uq_participant_code_lower", "participant", [sa.literal_column("lower(code)")], unique=True)
    op.create_table(
        "buffer_gate_decision",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("choice", sa.String(length=10), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint("choice in ('open', 'shut', 'test')", name=op.f("ck_buffer_gate_decision_choice")),
        sa.CheckConstraint("reason <> ''", name=op.f("ck_buffer_gate_decision_reason")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_buffer_gate_decision_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_buffer_gate_decision")),
    )
    op.create_index(op.f("ix_buffer_gate_decision_participant_id"), "buffer_gate_decision", ["participant_id"], unique=False)
    op.create_table(
        "characteristics_version",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("leads", postgresql.JSONB(astext_type=sa.Text()), server_default="[]", nullable=False),
        sa.Column("symptoms", postgresql.JSONB(astext_type=sa.Text()), server_default="[]", nullable=False),
        sa.Column("hand", sa.String(length=5), nullable=True),
        sa.Column("medication", postgresql.JSONB(astext_type=sa.Text()), server_default="[]", nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.CheckConstraint("hand in ('left', 'right')", name=op.f("ck_characteristics_version_hand")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_characteristics_version_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_characteristics_version")),
        sa.UniqueConstraint("participant_id", "version", name=op.f("uq_characteristics_version_participant_id_version")),
    )
    op.create_index(op.f("ix_characteristics_version_participant_id"), "characteristics_version", ["participant_id"], unique=False)
    op.create_table(
        "device",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("pseudonym", sa.String(length=64), nullable=False),
        sa.Column("kind", sa.String(length=40), nullable=False),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_device_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_device")),
        sa.UniqueConstraint("participant_id", "pseudonym", name=op.f("uq_device_participant_id_pseudonym")),
    )
    op.create_index(op.f("ix_device_participant_id"), "device", ["participant_id"], unique=False)
    op.create_table(
        "job",
        sa.Column("id", sa.String(length=36), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=True),
        sa.Column("kind", sa.String(length=40), nullable=False),
        sa.Column("status", sa.String(length=20), server_default="queued", nullable=False),
        sa.Column("progress", sa.Double(), server_default="0", nullable=False),
        sa.Column("message", sa.Text(), server_default="", nullable=False),
        sa.Column("params", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("result", postgresql.JSONB(astext_type=sa.Text()), nullable=True),
        sa.Column("error", sa.Text(), nullable=True),
        sa.Column("code_version", sa.String(length=80), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("finished_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("updated_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("cancel_requested_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("protocol", sa.Integer(), server_default="0", nullable=False),
        sa.Column("repeats", sa.String(length=36), nullable=True),
        sa.Column("urgency", sa.Integer(), server_default="50", nullable=False),
        sa.Column("place", sa.Integer(), server_default="0", nullable=False),
        sa.ForeignKeyConstraint(["repeats"], ["job.id"], name=op.f("fk_job_repeats_job")),
        sa.CheckConstraint("(finished_at is not null) = (status in ('succeeded', 'failed', 'cancelled'))", name=op.f("ck_job_finished")),
        sa.CheckConstraint("status in ('queued', 'running', 'succeeded', 'failed', 'cancelled')", name=op.f("ck_job_status")),
        sa.CheckConstraint("progress >= 0 and progress <= 1", name=op.f("ck_job_progress")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_job_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_job")),
    )
    op.create_index(op.f("ix_job_kind"), "job", ["kind"], unique=False)
    op.create_index(op.f("ix_job_participant_id"), "job", ["participant_id"], unique=False)
    op.create_table(
        "margins_version",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("grasp_share", sa.Double(), nullable=False),
        sa.Column("rating_points", sa.Double(), nullable=False),
        sa.Column("tremor_points", sa.Double(), nullable=False),
        sa.Column("test_within", sa.Double(), nullable=False),
        sa.Column("test_saves", sa.Double(), nullable=False),
        sa.Column("unsafe_beyond", sa.Double(), nullable=False),
        sa.Column("nearly_off_share", sa.Double(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.CheckConstraint(
            "grasp_share > 0 and grasp_share < 1 and rating_points > 0 and tremor_points > 0", name=op.f("ck_margins_version_margins")
        ),
        sa.CheckConstraint(
            "test_within > 0 and test_within < 1 and test_saves > 0 and test_saves < 1 and unsafe_beyond > 0 and unsafe_beyond < 1 and nearly_off_share >= 0 and nearly_off_share < 1",
            name=op.f("ck_margins_version_levels"),
        ),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_margins_version_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_margins_version")),
        sa.UniqueConstraint("participant_id", "version", name=op.f("uq_margins_version_participant_id_version")),
    )
    op.create_index(op.f("ix_margins_version_participant_id"), "margins_version", ["participant_id"], unique=False)
    op.create_table(
        "settings_version",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("xi_beta", sa.Double(), nullable=True),
        sa.Column("beta_unit", sa.String(length=40), nullable=True),
        sa.Column("beta_source", sa.String(length=40), nullable=True),
        sa.Column("window", sa.Integer(), nullable=False),
        sa.Column("period_s", sa.Double(), nullable=False),
        sa.Column("r_a", sa.Double(), nullable=False),
        sa.Column("r_b", sa.Double(), nullable=False),
        sa.Column("c1", sa.Double(), nullable=False),
        sa.Column("c2", sa.Double(), nullable=False),
        sa.Column("c3", sa.Double(), nullable=False),
        sa.Column("c4", sa.Double(), nullable=False),
        sa.Column("gamma", sa.Double(), nullable=False),
        sa.Column("lower_bound", sa.Double(), nullable=False),
        sa.Column("tremor_as_fraction", sa.Boolean(), nullable=False),
        sa.Column("cdbs_amplitude_ma", sa.Double(), nullable=True),
        sa.Column("beta_low_hz", sa.Double(), nullable=False),
        sa.Column("beta_high_hz", sa.Double(), nullable=False),
        sa.Column("min_valid_fraction", sa.Double(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("beta_measure", sa.String(length=10), server_default="rms", nullable=False),
        sa.Column("most_imputed", sa.SmallInteger(), server_default="0", nullable=False),
        sa.Column("pool_programmings", sa.Boolean(), server_default="false", nullable=False),
        sa.Column("design", sa.String(length=20), server_default="paper", nullable=False),
        sa.Column("design_ladder", sa.Boolean(), server_default="false", nullable=False),
        sa.Column("early_visits", sa.SmallInteger(), server_default="3", nullable=False),
        sa.Column("pool_shapes", sa.Boolean(), server_default="false", nullable=False),
        sa.CheckConstraint("beta_measure in ('rms', 'power')", name=op.f("ck_settings_version_beta_measure")),
        sa.CheckConstraint("design in ('stratified', 'paper')", name=op.f("ck_settings_version_design")),
        sa.CheckConstraint('"window" >= 1 and period_s > 0', name=op.f("ck_settings_version_window")),
        sa.CheckConstraint("beta_low_hz > 0 and beta_low_hz < beta_high_hz", name=op.f("ck_settings_version_beta_band")),
        sa.CheckConstraint("c1 >= 0 and c2 >= 0 and c3 >= 0 and c4 >= 0", name=op.f("ck_settings_version_weights")),
        sa.CheckConstraint("cdbs_amplitude_ma > 0", name=op.f("ck_settings_version_cdbs_amplitude")),
        sa.CheckConstraint("early_visits >= 1", name=op.f("ck_settings_version_early_visits")),
        sa.CheckConstraint("gamma >= 0 and gamma < 1", name=op.f("ck_settings_version_gamma")),
        sa.CheckConstraint("lower_bound >= 0 and lower_bound < 1", name=op.f("ck_settings_version_lower_bound")),
        sa.CheckConstraint("min_valid_fraction > 0 and min_valid_fraction <= 1", name=op.f("ck_settings_version_min_valid")),
        sa.CheckConstraint("most_imputed >= 0", name=op.f("ck_settings_version_most_imputed")),
        sa.CheckConstraint("r_a >= r_b", name=op.f("ck_settings_version_rewards")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_settings_version_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_settings_version")),
        sa.UniqueConstraint("participant_id", "version", name=op.f("uq_settings_version_participant_id_version")),
    )
    op.create_index(op.f("ix_settings_version_participant_id"), "settings_version", ["participant_id"], unique=False)
    op.create_table(
        "upload",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("status", sa.String(length=20), server_default="received", nullable=False),
        sa.Column("stated", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint("status in ('received', 'decoded', 'failed')", name=op.f("ck_upload_status")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_upload_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_upload")),
    )
    op.create_index(op.f("ix_upload_participant_id"), "upload", ["participant_id"], unique=False)
    op.create_table(
        "visit",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("date", sa.Date(), nullable=True),
        sa.Column("note", sa.Text(), server_default="", nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("number >= 1", name=op.f("ck_visit_number")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_visit_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_visit")),
        sa.UniqueConstraint("participant_id", "number", name=op.f("uq_visit_participant_id_number")),
    )
    op.create_index(op.f("ix_visit_participant_id"), "visit", ["participant_id"], unique=False)
    op.create_table(
        "buffer_snapshot",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("settings_version_id", sa.Integer(), nullable=False),
        sa.Column("pins_sha256", sa.String(length=64), nullable=False),
        sa.Column("file_sha256", sa.String(length=64), nullable=False),
        sa.Column("sessions", sa.Integer(), nullable=False),
        sa.Column("steps", sa.Integer(), nullable=False),
        sa.Column("median_steps", sa.Integer(), nullable=False),
        sa.Column("beta_unit", sa.String(length=40), nullable=False),
        sa.Column("beta_source", sa.String(length=40), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("characteristics_id", sa.Integer(), nullable=True),
        sa.CheckConstraint("sessions >= 1 and steps >= 1", name=op.f("ck_buffer_snapshot_not_empty")),
        sa.ForeignKeyConstraint(
            ["characteristics_id"],
            ["characteristics_version.id"],
            name=op.f("fk_buffer_snapshot_characteristics_id_characteristics_version"),
        ),
        sa.ForeignKeyConstraint(["file_sha256"], ["stored_file.sha256"], name=op.f("fk_buffer_snapshot_file_sha256_stored_file")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_buffer_snapshot_participant_id_participant")),
        sa.ForeignKeyConstraint(
            ["settings_version_id"], ["settings_version.id"], name=op.f("fk_buffer_snapshot_settings_version_id_settings_version")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_buffer_snapshot")),
        sa.UniqueConstraint("participant_id", "pins_sha256", name=op.f("uq_buffer_snapshot_participant_id_pins_sha256")),
    )
    op.create_index(op.f("ix_buffer_snapshot_participant_id"), "buffer_snapshot", ["participant_id"], unique=False)
    op.create_table(
        "cdbs_amplitude",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("visit_id", sa.Integer(), nullable=True),
        sa.Column("hemisphere", sa.String(length=5), nullable=False),
        sa.Column("program", sa.SmallInteger(), nullable=False),
        sa.Column("amplitude_ma", sa.Double(), nullable=False),
        sa.Column("removed_at", sa.DateTime(timezone=True), nullable=True),
        sa.CheckConstraint("hemisphere in ('left', 'right')", name=op.f("ck_cdbs_amplitude_hemisphere")),
        sa.CheckConstraint("amplitude_ma > 0", name=op.f("ck_cdbs_amplitude_amplitude")),
        sa.CheckConstraint("program between 0 and 3", name=op.f("ck_cdbs_amplitude_program")),
        sa.CheckConstraint("visit_id is not null or removed_at is not null", name=op.f("ck_cdbs_amplitude_belongs")),
        sa.ForeignKeyConstraint(["visit_id"], ["visit.id"], name=op.f("fk_cdbs_amplitude_visit_id_visit"), ondelete="SET NULL"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_cdbs_amplitude")),
    )
    op.create_index(op.f("ix_cdbs_amplitude_visit_id"), "cdbs_amplitude", ["visit_id"], unique=False)
    op.create_index(
        "uq_cdbs_amplitude_visit_id_hemisphere_program",
        "cdbs_amplitude",
        ["visit_id", "hemisphere", "program"],
        unique=True,
        postgresql_where=sa.text("removed_at is null"),
    )
    op.create_table(
        "dose",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("visit_id", sa.Integer(), nullable=False),
        sa.Column("drug", sa.String(length=30), nullable=False),
        sa.Column("mg", sa.Double(), nullable=False),
        sa.Column("taken_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("entered_by", sa.String(length=254), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("removed_at", sa.DateTime(timezone=True), nullable=True),
        sa.CheckConstraint(
            "drug in ('levodopa', 'levodopa_cr', 'levodopa_comt', 'levodopa_equivalent', 'apomorphine', 'pramipexole', 'ropinirole', 'rotigotine', 'selegiline', 'rasagiline', 'safinamide', 'amantadine', 'anticholinergic', 'muscle_relaxant', 'other')",
            name=op.f("ck_dose_drug"),
        ),
        sa.CheckConstraint("taken_at >= '1990-01-01Z' and taken_at < '2201-01-01Z'", name=op.f("ck_dose_taken_at")),
        sa.CheckConstraint("mg > 0 and mg <= 5000", name=op.f("ck_dose_mg")),
        sa.ForeignKeyConstraint(["visit_id"], ["visit.id"], name=op.f("fk_dose_visit_id_visit")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_dose")),
    )
    op.create_index(op.f("ix_dose_visit_id"), "dose", ["visit_id"], unique=False)
    op.create_index(
        "uq_dose_visit_id_drug_taken_at",
        "dose",
        ["visit_id", "drug", "taken_at"],
        unique=True,
        postgresql_where=sa.text("removed_at is null"),
    )
    op.create_table(
        "job_event",
        sa.Column("id", sa.BigInteger(), nullable=False),
        sa.Column("job_id", sa.String(length=36), nullable=False),
        sa.Column("step_key", sa.String(length=100), nullable=True),
        sa.Column("kind", sa.String(length=20), nullable=False),
        sa.Column("data", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), server_default=sa.text("clock_timestamp()"), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_job_event_job_id_job"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_job_event")),
    )
    op.create_index("ix_job_event_job_id_id", "job_event", ["job_id", "id"], unique=False)
    op.create_table(
        "job_step",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.String(length=36), nullable=False),
        sa.Column("key", sa.String(length=100), nullable=False),
        sa.Column("title", sa.String(length=200), nullable=False),
        sa.Column("position", sa.Integer(), nullable=False),
        sa.Column("weight", sa.Double(), server_default="1", nullable=False),
        sa.Column("status", sa.String(length=20), server_default="queued", nullable=False),
        sa.Column("progress", sa.Double(), server_default="0", nullable=False),
        sa.Column("message", sa.Text(), server_default="", nullable=False),
        sa.Column("attempts", sa.Integer(), server_default="0", nullable=False),
        sa.Column("worker", sa.String(length=100), nullable=True),
        sa.Column("result", postgresql.JSONB(astext_type=sa.Text()), nullable=True),
        sa.Column("started_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("finished_at", sa.DateTime(timezone=True), nullable=True),
        sa.CheckConstraint("status in ('queued', 'running', 'succeeded', 'failed', 'cancelled')", name=op.f("ck_job_step_status")),
        sa.CheckConstraint("progress >= 0 and progress <= 1", name=op.f("ck_job_step_progress")),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_job_step_job_id_job"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_job_step")),
        sa.UniqueConstraint("job_id", "key", name=op.f("uq_job_step_job_id_key")),
    )
    op.create_index(op.f("ix_job_step_job_id"), "job_step", ["job_id"], unique=False)
    op.create_table(
        "margins_lock",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("margins_version_id", sa.Integer(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint("reason <> ''", name=op.f("ck_margins_lock_reason")),
        sa.ForeignKeyConstraint(
            ["margins_version_id"], ["margins_version.id"], name=op.f("fk_margins_lock_margins_version_id_margins_version")
        ),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_margins_lock_participant_id_participant")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_margins_lock")),
    )
    op.create_index(op.f("ix_margins_lock_participant_id"), "margins_lock", ["participant_id"], unique=False)
    op.create_table(
        "visit_lock",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("visit_id", sa.Integer(), nullable=False),
        sa.Column("locked", sa.Boolean(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("settings_version_id", sa.Integer(), nullable=True),
        sa.CheckConstraint("reason <> ''", name=op.f("ck_visit_lock_reason")),
        sa.ForeignKeyConstraint(
            ["settings_version_id"], ["settings_version.id"], name=op.f("fk_visit_lock_settings_version_id_settings_version")
        ),
        sa.ForeignKeyConstraint(["visit_id"], ["visit.id"], name=op.f("fk_visit_lock_visit_id_visit")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_visit_lock")),
    )
    op.create_index(op.f("ix_visit_lock_visit_id"), "visit_lock", ["visit_id"], unique=False)
    op.create_table(
        "evaluation",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("snapshot_id", sa.Integer(), nullable=False),
        sa.Column("settings_version_id", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.String(length=36), nullable=True),
        sa.Column("first_answer", sa.Boolean(), server_default=sa.text("false"), nullable=False),
        sa.Column("horizon_steps", sa.Integer(), nullable=False),
        sa.Column("gamma", sa.Double(), nullable=False),
        sa.Column("default_method", sa.String(length=40), nullable=False),
        sa.Column("config", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("diagnostics", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("code_version", sa.String(length=80), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint("horizon_steps >= 1", name=op.f("ck_evaluation_horizon")),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_evaluation_job_id_job")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_evaluation_participant_id_participant")),
        sa.ForeignKeyConstraint(
            ["settings_version_id"], ["settings_version.id"], name=op.f("fk_evaluation_settings_version_id_settings_version")
        ),
        sa.ForeignKeyConstraint(["snapshot_id"], ["buffer_snapshot.id"], name=op.f("fk_evaluation_snapshot_id_buffer_snapshot")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_evaluation")),
        sa.UniqueConstraint("job_id", "first_answer", name=op.f("uq_evaluation_job_id_first_answer")),
    )
    op.create_index(op.f("ix_evaluation_participant_id"), "evaluation", ["participant_id"], unique=False)
    op.create_table(
        "sweep",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("snapshot_id", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.String(length=36), nullable=False),
        sa.Column("config", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("baselines", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("code_version", sa.String(length=80), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_sweep_job_id_job")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_sweep_participant_id_participant")),
        sa.ForeignKeyConstraint(["snapshot_id"], ["buffer_snapshot.id"], name=op.f("fk_sweep_snapshot_id_buffer_snapshot")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_sweep")),
        sa.UniqueConstraint("job_id", name=op.f("uq_sweep_job_id")),
        sa.UniqueConstraint("participant_id", "name", name=op.f("uq_sweep_participant_id_name")),
    )
    op.create_index(op.f("ix_sweep_participant_id"), "sweep", ["participant_id"], unique=False)
    op.create_table(
        "plan",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("visit_id", sa.Integer(), nullable=False),
        sa.Column("evaluation_id", sa.Integer(), nullable=True),
        sa.Column("status", sa.String(length=20), server_default="draft", nullable=False),
        sa.Column("seed", sa.Integer(), nullable=False),
        sa.Column("rules", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("note", sa.Text(), server_default="", nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("approved_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("approved_by", sa.String(length=254), nullable=True),
        sa.Column("blinded", sa.Boolean(), server_default="false", nullable=False),
        sa.Column("starts_at", sa.Time(), nullable=True),
        sa.Column("key_opened_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("key_opened_by", sa.String(length=254), nullable=True),
        sa.Column("key_opened_reason", sa.Text(), nullable=True),
        sa.Column("key_opened_in_emergency", sa.Boolean(), server_default="false", nullable=False),
        sa.CheckConstraint("(status = 'draft') = (approved_at is null) or status = 'superseded'", name=op.f("ck_plan_approval")),
        sa.CheckConstraint("status in ('draft', 'approved', 'superseded')", name=op.f("ck_plan_status")),
        sa.CheckConstraint("(key_opened_at is null) = (key_opened_by is null)", name=op.f("ck_plan_key_opened")),
        sa.CheckConstraint(
            "key_opened_at is null or key_opened_in_emergency or key_opened_reason is not null", name=op.f("ck_plan_key_reason")
        ),
        sa.ForeignKeyConstraint(["evaluation_id"], ["evaluation.id"], name=op.f("fk_plan_evaluation_id_evaluation")),
        sa.ForeignKeyConstraint(["visit_id"], ["visit.id"], name=op.f("fk_plan_visit_id_visit")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_plan")),
    )
    op.create_index(op.f("ix_plan_visit_id"), "plan", ["visit_id"], unique=False)
    op.create_index("uq_plan_visit_live", "plan", ["visit_id"], unique=True, postgresql_where="status <> 'superseded'")
    op.create_table(
        "policy",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("kind", sa.String(length=20), nullable=False),
        sa.Column("algorithm", sa.String(length=40), nullable=False),
        sa.Column("teacher_id", sa.Integer(), nullable=True),
        sa.Column("parent_id", sa.Integer(), nullable=True),
        sa.Column("snapshot_id", sa.Integer(), nullable=True),
        sa.Column("settings_version_id", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.String(length=36), nullable=True),
        sa.Column("job_step", sa.String(length=100), nullable=True),
        sa.Column("config", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("seed", sa.Integer(), nullable=True),
        sa.Column("onnx_sha256", sa.String(length=64), nullable=False),
        sa.Column("checkpoint_sha256", sa.String(length=64), nullable=True),
        sa.Column("metrics", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("code_version", sa.String(length=80), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("retired_reason", sa.Text(), nullable=True),
        sa.Column("sweep_id", sa.Integer(), nullable=True),
        sa.CheckConstraint("(kind = 'distilled') = (teacher_id is not null)", name=op.f("ck_policy_teacher")),
        sa.CheckConstraint("kind in ('trained', 'distilled', 'external', 'baseline')", name=op.f("ck_policy_kind")),
        sa.CheckConstraint("kind not in ('trained', 'distilled') or snapshot_id is not null", name=op.f("ck_policy_snapshot")),
        sa.ForeignKeyConstraint(["checkpoint_sha256"], ["stored_file.sha256"], name=op.f("fk_policy_checkpoint_sha256_stored_file")),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_policy_job_id_job")),
        sa.ForeignKeyConstraint(["onnx_sha256"], ["stored_file.sha256"], name=op.f("fk_policy_onnx_sha256_stored_file")),
        sa.ForeignKeyConstraint(["parent_id"], ["policy.id"], name=op.f("fk_policy_parent_id_policy")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_policy_participant_id_participant")),
        sa.ForeignKeyConstraint(
            ["settings_version_id"], ["settings_version.id"], name=op.f("fk_policy_settings_version_id_settings_version")
        ),
        sa.ForeignKeyConstraint(["snapshot_id"], ["buffer_snapshot.id"], name=op.f("fk_policy_snapshot_id_buffer_snapshot")),
        sa.ForeignKeyConstraint(["sweep_id"], ["sweep.id"], name=op.f("fk_policy_sweep_id_sweep")),
        sa.ForeignKeyConstraint(["teacher_id"], ["policy.id"], name=op.f("fk_policy_teacher_id_policy")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_policy")),
        sa.UniqueConstraint("job_id", "job_step", name=op.f("uq_policy_job_id_job_step")),
        sa.UniqueConstraint("participant_id", "name", name=op.f("uq_policy_participant_id_name")),
    )
    op.create_index(op.f("ix_policy_job_id"), "policy", ["job_id"], unique=False)
    op.create_index(op.f("ix_policy_participant_id"), "policy", ["participant_id"], unique=False)
    op.create_index(op.f("ix_policy_sweep_id"), "policy", ["sweep_id"], unique=False)
    op.create_table(
        "declared_confirmation",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("policy_id", sa.Integer(), nullable=False),
        sa.Column("margins_lock_id", sa.Integer(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("clock_timestamp()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint("reason <> ''", name=op.f("ck_declared_confirmation_reason")),
        sa.ForeignKeyConstraint(
            ["margins_lock_id"], ["margins_lock.id"], name=op.f("fk_declared_confirmation_margins_lock_id_margins_lock")
        ),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_declared_confirmation_participant_id_participant")),
        sa.ForeignKeyConstraint(["policy_id"], ["policy.id"], name=op.f("fk_declared_confirmation_policy_id_policy")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_declared_confirmation")),
        sa.UniqueConstraint("policy_id", name=op.f("uq_declared_confirmation_policy_id")),
    )
    op.create_index(op.f("ix_declared_confirmation_participant_id"), "declared_confirmation", ["participant_id"], unique=False)
    op.create_table(
        "estimate",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("evaluation_id", sa.Integer(), nullable=False),
        sa.Column("policy_id", sa.Integer(), nullable=False),
        sa.Column("method", sa.String(length=40), nullable=False),
        sa.Column("value", sa.Double(), nullable=False),
        sa.Column("low", sa.Double(), nullable=False),
        sa.Column("high", sa.Double(), nullable=False),
        sa.Column("level", sa.Double(), nullable=False),
        sa.Column("standard_error", sa.Double(), nullable=True),
        sa.Column("supported", sa.Boolean(), nullable=False),
        sa.Column("flags", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("predicted", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("details", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.CheckConstraint("level > 0 and level < 1", name=op.f("ck_estimate_level")),
        sa.CheckConstraint("low <= value and value <= high", name=op.f("ck_estimate_interval")),
        sa.ForeignKeyConstraint(
            ["evaluation_id"], ["evaluation.id"], name=op.f("fk_estimate_evaluation_id_evaluation"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(["policy_id"], ["policy.id"], name=op.f("fk_estimate_policy_id_policy")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_estimate")),
        sa.UniqueConstraint("evaluation_id", "policy_id", "method", name=op.f("uq_estimate_evaluation_id_policy_id_method")),
    )
    op.create_index(op.f("ix_estimate_policy_id"), "estimate", ["policy_id"], unique=False)
    op.create_table(
        "plan_item",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("plan_id", sa.Integer(), nullable=False),
        sa.Column("position", sa.Integer(), nullable=False),
        sa.Column("controller", sa.String(length=20), nullable=False),
        sa.Column("policy_id", sa.Integer(), nullable=True),
        sa.Column("minutes", sa.Double(), nullable=False),
        sa.Column("washout_minutes", sa.Double(), nullable=False),
        sa.Column("note", sa.Text(), server_default="", nullable=False),
        sa.Column("design", postgresql.JSONB(none_as_null=True, astext_type=sa.Text()), nullable=True),
        sa.Column("verdict", sa.String(length=20), nullable=True),
        sa.Column("min_fraction", sa.Double(), nullable=True),
        sa.Column("override_reason", sa.Text(), nullable=True),
        sa.Column("hemisphere", sa.String(length=5), nullable=True),
        sa.Column("cdbs_ma", sa.Double(), nullable=True),
        sa.Column("min_ma", sa.Double(), nullable=True),
        sa.Column("max_ma", sa.Double(), nullable=True),
        sa.Column("ramp_ma_per_s", sa.Double(), nullable=True),
        sa.Column("repeat", sa.SmallInteger(), server_default="1", nullable=False),
        sa.Column("label", sa.String(length=10), nullable=True),
        sa.Column("break_minutes", sa.Double(), server_default="0", nullable=False),
        sa.Column("medication", sa.Text(), server_default="", nullable=False),
        sa.CheckConstraint("controller in ('cdbs', 'rl', 'distilled', 'no_dbs', 'random', 'other')", name=op.f("ck_plan_item_controller")),
        sa.CheckConstraint("hemisphere in ('left', 'right')", name=op.f("ck_plan_item_hemisphere")),
        sa.CheckConstraint("override_reason is null or override_reason <> ''", name=op.f("ck_plan_item_override_reason")),
        sa.CheckConstraint('"repeat" >= 1', name=op.f("ck_plan_item_repeat")),
        sa.CheckConstraint("break_minutes >= 0", name=op.f("ck_plan_item_break_minutes")),
        sa.CheckConstraint("min_fraction > 0 and min_fraction <= 1", name=op.f("ck_plan_item_min_fraction")),
        sa.CheckConstraint("min_ma >= 0 and min_ma <= max_ma and ramp_ma_per_s > 0 and cdbs_ma > 0", name=op.f("ck_plan_item_limits")),
        sa.CheckConstraint("minutes > 0 and washout_minutes >= 0", name=op.f("ck_plan_item_minutes")),
        sa.ForeignKeyConstraint(["plan_id"], ["plan.id"], name=op.f("fk_plan_item_plan_id_plan"), ondelete="CASCADE"),
        sa.ForeignKeyConstraint(["policy_id"], ["policy.id"], name=op.f("fk_plan_item_policy_id_policy")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_plan_item")),
        sa.UniqueConstraint("plan_id", "position", name=op.f("uq_plan_item_plan_id_position")),
    )
    op.create_table(
        "bundle_release",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("policy_id", sa.Integer(), nullable=True),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("hemisphere", sa.String(length=10), nullable=True),
        sa.Column("min_ma", sa.Double(), nullable=False),
        sa.Column("max_ma", sa.Double(), nullable=False),
        sa.Column("cdbs_ma", sa.Double(), nullable=False),
        sa.Column("ramp_ma_per_s", sa.Double(), nullable=False),
        sa.Column("approvals", postgresql.JSONB(none_as_null=True, astext_type=sa.Text()), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.Column("plan_item_id", sa.Integer(), nullable=True),
        sa.Column("content_sha256", sa.String(length=64), nullable=True),
        sa.CheckConstraint("hemisphere in ('left', 'right')", name=op.f("ck_bundle_release_hemisphere")),
        sa.CheckConstraint(
            "min_ma >= 0 and min_ma <= cdbs_ma and cdbs_ma <= max_ma and ramp_ma_per_s > 0", name=op.f("ck_bundle_release_limits")
        ),
        sa.CheckConstraint("policy_id is not null or plan_item_id is not null", name=op.f("ck_bundle_release_what")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_bundle_release_participant_id_participant")),
        sa.ForeignKeyConstraint(["plan_item_id"], ["plan_item.id"], name=op.f("fk_bundle_release_plan_item_id_plan_item")),
        sa.ForeignKeyConstraint(["policy_id"], ["policy.id"], name=op.f("fk_bundle_release_policy_id_policy")),
        sa.ForeignKeyConstraint(["sha256"], ["stored_file.sha256"], name=op.f("fk_bundle_release_sha256_stored_file")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_bundle_release")),
    )
    op.create_index(op.f("ix_bundle_release_content_sha256"), "bundle_release", ["content_sha256"], unique=False)
    op.create_index(op.f("ix_bundle_release_participant_id"), "bundle_release", ["participant_id"], unique=False)
    op.create_index(op.f("ix_bundle_release_plan_item_id"), "bundle_release", ["plan_item_id"], unique=False)
    op.create_index(op.f("ix_bundle_release_policy_id"), "bundle_release", ["policy_id"], unique=False)
    op.create_table(
        "day_entry",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("uuid", sa.Uuid(), nullable=False),
        sa.Column("plan_id", sa.Integer(), nullable=False),
        sa.Column("plan_item_id", sa.Integer(), nullable=True),
        sa.Column("attempt", sa.SmallInteger(), nullable=True),
        sa.Column("kind", sa.String(length=20), nullable=False),
        sa.Column("payload", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("replaces", postgresql.JSONB(astext_type=sa.Text()), server_default="[]", nullable=False),
        sa.Column("device_time", sa.DateTime(timezone=True), nullable=False),
        sa.Column("clock_offset_ms", sa.BigInteger(), nullable=True),
        sa.Column("received_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("entered_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint(
            "kind in ('start', 'stop', 'stop_cause', 'rating', 'grasp', 'dyskinesia', 'speech', 'gait', 'note', 'adverse_event', 'skip', 'repeat', 'session_end', 'clinical_settings', 'dose')",
            name=op.f("ck_day_entry_kind"),
        ),
        sa.CheckConstraint(
            "plan_item_id is not null or kind in ('note', 'adverse_event', 'clinical_settings', 'dose')", name=op.f("ck_day_entry_session")
        ),
        sa.CheckConstraint("(plan_item_id is null) = (attempt is null) and attempt >= 1", name=op.f("ck_day_entry_attempt")),
        sa.ForeignKeyConstraint(["plan_id"], ["plan.id"], name=op.f("fk_day_entry_plan_id_plan")),
        sa.ForeignKeyConstraint(["plan_item_id"], ["plan_item.id"], name=op.f("fk_day_entry_plan_item_id_plan_item")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_day_entry")),
        sa.UniqueConstraint("uuid", name=op.f("uq_day_entry_uuid")),
    )
    op.create_index(op.f("ix_day_entry_plan_id"), "day_entry", ["plan_id"], unique=False)
    op.create_index(op.f("ix_day_entry_plan_item_id"), "day_entry", ["plan_item_id"], unique=False)
    op.create_table(
        "session",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("visit_id", sa.Integer(), nullable=False),
        sa.Column("ordinal", sa.Integer(), nullable=False),
        sa.Column("controller", sa.String(length=20), nullable=True),
        sa.Column("policy_id", sa.Integer(), nullable=True),
        sa.Column("hemisphere", sa.String(length=5), nullable=True),
        sa.Column("status", sa.String(length=20), server_default="confirmed", nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("duration_s", sa.Double(), nullable=False),
        sa.Column("control_stream", sa.String(length=40), server_default="beta", nullable=False),
        sa.Column("control_channel", sa.String(length=80), nullable=True),
        sa.Column("excluded_reason", sa.Text(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("stopped_reason", sa.Text(), nullable=True),
        sa.Column("medication_h", sa.Double(), nullable=True),
        sa.Column("plan_item_id", sa.Integer(), nullable=True),
        sa.Column("control_program", sa.SmallInteger(), nullable=True),
        sa.Column("activity", sa.String(length=10), nullable=True),
        sa.CheckConstraint("activity in ('rest', 'light', 'exercise', 'meal', 'sleep')", name=op.f("ck_session_activity")),
        sa.CheckConstraint("controller in ('cdbs', 'rl', 'distilled', 'no_dbs', 'random', 'other')", name=op.f("ck_session_controller")),
        sa.CheckConstraint("excluded_reason is null or excluded_reason <> ''", name=op.f("ck_session_excluded_reason")),
        sa.CheckConstraint("hemisphere in ('left', 'right')", name=op.f("ck_session_hemisphere")),
        sa.CheckConstraint("started_at >= '1990-01-01Z' and started_at < '2201-01-01Z'", name=op.f("ck_session_started_at")),
        sa.CheckConstraint("status = 'proposed' or controller is not null", name=op.f("ck_session_controller_stated")),
        sa.CheckConstraint("status in ('proposed', 'confirmed')", name=op.f("ck_session_status")),
        sa.CheckConstraint("stopped_reason is null or stopped_reason <> ''", name=op.f("ck_session_stopped_reason")),
        sa.CheckConstraint("control_program between 0 and 15", name=op.f("ck_session_control_program")),
        sa.CheckConstraint("duration_s >= 0", name=op.f("ck_session_duration")),
        sa.CheckConstraint("medication_h >= 0 and medication_h <= 72", name=op.f("ck_session_medication")),
        sa.ForeignKeyConstraint(["plan_item_id"], ["plan_item.id"], name=op.f("fk_session_plan_item_id_plan_item")),
        sa.ForeignKeyConstraint(["policy_id"], ["policy.id"], name=op.f("fk_session_policy_id_policy")),
        sa.ForeignKeyConstraint(["visit_id"], ["visit.id"], name=op.f("fk_session_visit_id_visit")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_session")),
        sa.UniqueConstraint("plan_item_id", name=op.f("uq_session_plan_item_id")),
        sa.UniqueConstraint("visit_id", "ordinal", name=op.f("uq_session_visit_id_ordinal")),
    )
    op.create_index(op.f("ix_session_policy_id"), "session", ["policy_id"], unique=False)
    op.create_index(op.f("ix_session_visit_id"), "session", ["visit_id"], unique=False)
    op.create_table(
        "adverse_event",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("visit_id", sa.Integer(), nullable=True),
        sa.Column("session_id", sa.Integer(), nullable=True),
        sa.Column("policy_id", sa.Integer(), nullable=True),
        sa.Column("occurred_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("entry_key", sa.String(length=64), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("entry_key <> ''", name=op.f("ck_adverse_event_entry_key")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_adverse_event_participant_id_participant")),
        sa.ForeignKeyConstraint(["policy_id"], ["policy.id"], name=op.f("fk_adverse_event_policy_id_policy")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_adverse_event_session_id_session")),
        sa.ForeignKeyConstraint(["visit_id"], ["visit.id"], name=op.f("fk_adverse_event_visit_id_visit")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_adverse_event")),
        sa.UniqueConstraint("participant_id", "entry_key", name=op.f("uq_adverse_event_participant_id_entry_key")),
    )
    op.create_index(op.f("ix_adverse_event_policy_id"), "adverse_event", ["policy_id"], unique=False)
    op.create_index(op.f("ix_adverse_event_session_id"), "adverse_event", ["session_id"], unique=False)
    op.create_index(op.f("ix_adverse_event_visit_id"), "adverse_event", ["visit_id"], unique=False)
    op.create_table(
        "qoc",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("session_id", sa.Integer(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("grasp_hz", sa.Double(), nullable=True),
        sa.Column("rating", sa.SmallInteger(), nullable=True),
        sa.Column("tremor_percent", sa.Double(), nullable=True),
        sa.Column("entered_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("derived", postgresql.JSONB(astext_type=sa.Text()), server_default="[]", nullable=False),
        sa.Column("from_day", postgresql.JSONB(astext_type=sa.Text()), server_default="[]", nullable=False),
        sa.CheckConstraint("grasp_hz >= 0 and grasp_hz < 20", name=op.f("ck_qoc_grasp")),
        sa.CheckConstraint("rating between 1 and 10", name=op.f("ck_qoc_rating")),
        sa.CheckConstraint("tremor_percent between 0 and 100", name=op.f("ck_qoc_tremor")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_qoc_session_id_session"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_qoc")),
        sa.UniqueConstraint("session_id", "revision", name=op.f("uq_qoc_session_id_revision")),
    )
    op.create_index(op.f("ix_qoc_session_id"), "qoc", ["session_id"], unique=False)
    op.create_table(
        "session_conditions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("session_id", sa.Integer(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("origin", sa.String(length=10), nullable=False),
        sa.Column("lower_bound", sa.Double(), nullable=False),
        sa.Column("window", sa.Integer(), nullable=False),
        sa.Column("period_s", sa.Double(), nullable=False),
        sa.Column("xi_beta", sa.Double(), nullable=True),
        sa.Column("min_ma", sa.Double(), nullable=True),
        sa.Column("max_ma", sa.Double(), nullable=True),
        sa.Column("seed", sa.BigInteger(), nullable=True),
        sa.Column("design", sa.String(length=40), nullable=True),
        sa.Column("design_parameters", postgresql.JSONB(astext_type=sa.Text()), server_default="{}", nullable=False),
        sa.Column("lead_amplitude_ma", sa.Double(), nullable=True),
        sa.Column("cdbs_amplitude_ma", sa.Double(), nullable=True),
        sa.Column("programming", postgresql.JSONB(astext_type=sa.Text()), server_default="[]", nullable=False),
        sa.Column("entered_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("origin in ('stated', 'settings', 'assumed')", name=op.f("ck_session_conditions_origin")),
        sa.CheckConstraint('"window" >= 1 and period_s > 0', name=op.f("ck_session_conditions_window")),
        sa.CheckConstraint("lead_amplitude_ma >= 0 and cdbs_amplitude_ma > 0", name=op.f("ck_session_conditions_amplitudes")),
        sa.CheckConstraint("lower_bound >= 0 and lower_bound < 1", name=op.f("ck_session_conditions_lower_bound")),
        sa.CheckConstraint("min_ma >= 0 and max_ma >= min_ma", name=op.f("ck_session_conditions_limits")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_session_conditions_session_id_session"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_session_conditions")),
        sa.UniqueConstraint("session_id", "revision", name=op.f("uq_session_conditions_session_id_revision")),
    )
    op.create_index(op.f("ix_session_conditions_session_id"), "session_conditions", ["session_id"], unique=False)
    op.create_table(
        "session_proposal",
        sa.Column("session_id", sa.Integer(), nullable=False),
        sa.Column("upload_id", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), server_default="1", nullable=False),
        sa.Column("visit_open", sa.Boolean(), nullable=False),
        sa.Column("evidence", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("changed_by", sa.String(length=254), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("version >= 1", name=op.f("ck_session_proposal_version")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_session_proposal_session_id_session"), ondelete="CASCADE"),
        sa.ForeignKeyConstraint(["upload_id"], ["upload.id"], name=op.f("fk_session_proposal_upload_id_upload")),
        sa.PrimaryKeyConstraint("session_id", name=op.f("pk_session_proposal")),
    )
    op.create_index(op.f("ix_session_proposal_upload_id"), "session_proposal", ["upload_id"], unique=False)
    op.create_table(
        "upload_file",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("upload_id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=255), nullable=False),
        sa.Column("kind", sa.String(length=40), server_default="unknown", nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("original_sha256", sa.String(length=64), nullable=False),
        sa.Column("stored_sha256", sa.String(length=64), nullable=True),
        sa.Column("quarantine_sha256", sa.String(length=64), nullable=True),
        sa.Column("redactor_version", sa.Integer(), nullable=True),
        sa.Column("status", sa.String(length=20), server_default="received", nullable=False),
        sa.Column("report", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("session_id", sa.Integer(), nullable=True),
        sa.Column("released_sha256", sa.String(length=64), nullable=True),
        sa.Column("reviewed_by", sa.String(length=254), nullable=True),
        sa.Column("reviewed_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("decided_by", sa.String(length=254), nullable=True),
        sa.Column("decided_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("decision_reason", sa.Text(), nullable=True),
        sa.Column("column_mapping_id", sa.Integer(), nullable=True),
        sa.CheckConstraint("status in ('received', 'decoded', 'failed', 'released', 'discarded')", name=op.f("ck_upload_file_status")),
        sa.CheckConstraint(
            "(decided_at is null) = (decided_by is null) and (decided_at is null) = (decision_reason is null)",
            name=op.f("ck_upload_file_decision"),
        ),
        sa.ForeignKeyConstraint(["column_mapping_id"], ["column_mapping.id"], name=op.f("fk_upload_file_column_mapping_id_column_mapping")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_upload_file_participant_id_participant")),
        sa.ForeignKeyConstraint(["quarantine_sha256"], ["stored_file.sha256"], name=op.f("fk_upload_file_quarantine_sha256_stored_file")),
        sa.ForeignKeyConstraint(["released_sha256"], ["stored_file.sha256"], name=op.f("fk_upload_file_released_sha256_stored_file")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_upload_file_session_id_session"), ondelete="SET NULL"),
        sa.ForeignKeyConstraint(["stored_sha256"], ["stored_file.sha256"], name=op.f("fk_upload_file_stored_sha256_stored_file")),
        sa.ForeignKeyConstraint(["upload_id"], ["upload.id"], name=op.f("fk_upload_file_upload_id_upload")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_upload_file")),
    )
    op.create_index(op.f("ix_upload_file_column_mapping_id"), "upload_file", ["column_mapping_id"], unique=False)
    op.create_index(op.f("ix_upload_file_original_sha256"), "upload_file", ["original_sha256"], unique=False)
    op.create_index(op.f("ix_upload_file_participant_id"), "upload_file", ["participant_id"], unique=False)
    op.create_index(op.f("ix_upload_file_session_id"), "upload_file", ["session_id"], unique=False)
    op.create_index(op.f("ix_upload_file_upload_id"), "upload_file", ["upload_id"], unique=False)
    op.create_index(
        "uq_upload_file_participant_original",
        "upload_file",
        ["participant_id", "original_sha256"],
        unique=True,
        postgresql_where="status = 'decoded'",
    )
    op.create_table(
        "adverse_event_revision",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("event_id", sa.Integer(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("kind", sa.String(length=30), nullable=True),
        sa.Column("severity", sa.String(length=10), nullable=False),
        sa.Column("serious", sa.Boolean(), nullable=False),
        sa.Column("note", sa.Text(), server_default="", nullable=False),
        sa.Column("relation", sa.String(length=20), nullable=True),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("action", sa.String(length=20), nullable=True),
        sa.Column("outcome", sa.String(length=20), nullable=True),
        sa.Column("cleared_reason", sa.Text(), nullable=True),
        sa.Column("entered_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("cleared_reason is null or cleared_reason <> ''", name=op.f("ck_adverse_event_revision_cleared_reason")),
        sa.CheckConstraint("kind <> 'other' or severity = 'none' or note <> ''", name=op.f("ck_adverse_event_revision_other_described")),
        sa.CheckConstraint("severity <> 'none' or not serious", name=op.f("ck_adverse_event_revision_serious")),
        sa.CheckConstraint("severity = 'none' or kind is not null", name=op.f("ck_adverse_event_revision_kind_stated")),
        sa.CheckConstraint(
            "severity in ('none', 'mild', 'moderate', 'severe', 'not_stated')", name=op.f("ck_adverse_event_revision_severity")
        ),
        sa.CheckConstraint(
            "relation in ('not_related', 'possible', 'probable', 'causal')", name=op.f("ck_adverse_event_revision_relation")
        ),
        sa.CheckConstraint(
            "action in ('none', 'stimulation_changed', 'session_stopped', 'medication', 'other')",
            name=op.f("ck_adverse_event_revision_action"),
        ),
        sa.CheckConstraint(
            "outcome in ('recovered', 'recovering', 'not_recovered', 'lasting_harm', 'fatal')",
            name=op.f("ck_adverse_event_revision_outcome"),
        ),
        sa.ForeignKeyConstraint(["event_id"], ["adverse_event.id"], name=op.f("fk_adverse_event_revision_event_id_adverse_event")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_adverse_event_revision")),
        sa.UniqueConstraint("event_id", "revision", name=op.f("uq_adverse_event_revision_event_id_revision")),
    )
    op.create_table(
        "data_query",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("session_id", sa.Integer(), nullable=True),
        sa.Column("upload_id", sa.Integer(), nullable=True),
        sa.Column("field", sa.String(length=40), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("visit_id", sa.Integer(), nullable=True),
        sa.Column("event_id", sa.Integer(), nullable=True),
        sa.Column("dose_id", sa.Integer(), nullable=True),
        sa.Column("record", sa.String(length=20), nullable=True),
        sa.CheckConstraint("record in ('settings', 'characteristics')", name=op.f("ck_data_query_record")),
        sa.CheckConstraint(
            "num_nonnulls(session_id, upload_id, visit_id, dose_id, event_id, record) = 1", name=op.f("ck_data_query_one_subject")
        ),
        sa.ForeignKeyConstraint(["event_id"], ["adverse_event.id"], name=op.f("fk_data_query_event_id_adverse_event")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_data_query_participant_id_participant")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_data_query_session_id_session")),
        sa.ForeignKeyConstraint(["upload_id"], ["upload.id"], name=op.f("fk_data_query_upload_id_upload")),
        sa.ForeignKeyConstraint(["visit_id"], ["visit.id"], name=op.f("fk_data_query_visit_id_visit")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_data_query")),
    )
    op.create_index(op.f("ix_data_query_event_id"), "data_query", ["event_id"], unique=False)
    op.create_index(op.f("ix_data_query_participant_id"), "data_query", ["participant_id"], unique=False)
    op.create_index(op.f("ix_data_query_session_id"), "data_query", ["session_id"], unique=False)
    op.create_index(op.f("ix_data_query_upload_id"), "data_query", ["upload_id"], unique=False)
    op.create_index(op.f("ix_data_query_visit_id"), "data_query", ["visit_id"], unique=False)
    op.create_table(
        "grasp_test",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("session_id", sa.Integer(), nullable=True),
        sa.Column("upload_file_id", sa.Integer(), nullable=False),
        sa.Column("hand", sa.String(length=5), nullable=True),
        sa.Column("n", sa.Integer(), nullable=False),
        sa.Column("open_fist_s_f64", sa.LargeBinary(), nullable=False),
        sa.Column("implausible", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("removed_at", sa.DateTime(timezone=True), nullable=True),
        sa.CheckConstraint("hand in ('left', 'right')", name=op.f("ck_grasp_test_hand")),
        sa.CheckConstraint("n >= 1 and octet_length(open_fist_s_f64) = 8 * n", name=op.f("ck_grasp_test_length")),
        sa.CheckConstraint("session_id is not null or removed_at is not null", name=op.f("ck_grasp_test_belongs")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_grasp_test_session_id_session"), ondelete="SET NULL"),
        sa.ForeignKeyConstraint(["upload_file_id"], ["upload_file.id"], name=op.f("fk_grasp_test_upload_file_id_upload_file")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_grasp_test")),
    )
    op.create_index(op.f("ix_grasp_test_upload_file_id"), "grasp_test", ["upload_file_id"], unique=False)
    op.create_index(
        "uq_grasp_test_session_id_upload_file_id_hand",
        "grasp_test",
        ["session_id", "upload_file_id", "hand"],
        unique=True,
        postgresql_nulls_not_distinct=True,
        postgresql_where=sa.text("removed_at is null"),
    )
    op.create_table(
        "recording",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("device_id", sa.Integer(), nullable=False),
        sa.Column("upload_file_id", sa.Integer(), nullable=True),
        sa.Column("fingerprint", sa.String(length=64), nullable=False),
        sa.Column("hemisphere", sa.String(length=5), nullable=True),
        sa.Column("clock", sa.String(length=10), nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("duration_s", sa.Double(), nullable=False),
        sa.Column("details", postgresql.JSONB(astext_type=sa.Text()), nullable=False),
        sa.Column("superseded_by_id", sa.Integer(), nullable=True),
        sa.CheckConstraint("clock in ('device', 'pc', 'table')", name=op.f("ck_recording_clock")),
        sa.CheckConstraint("hemisphere in ('left', 'right')", name=op.f("ck_recording_hemisphere")),
        sa.CheckConstraint("started_at >= '1990-01-01Z' and started_at < '2201-01-01Z'", name=op.f("ck_recording_started_at")),
        sa.ForeignKeyConstraint(["device_id"], ["device.id"], name=op.f("fk_recording_device_id_device")),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_recording_participant_id_participant")),
        sa.ForeignKeyConstraint(["superseded_by_id"], ["recording.id"], name=op.f("fk_recording_superseded_by_id_recording")),
        sa.ForeignKeyConstraint(["upload_file_id"], ["upload_file.id"], name=op.f("fk_recording_upload_file_id_upload_file")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_recording")),
        sa.UniqueConstraint("participant_id", "fingerprint", name=op.f("uq_recording_participant_id_fingerprint")),
    )
    op.create_index(op.f("ix_recording_device_id"), "recording", ["device_id"], unique=False)
    op.create_index(op.f("ix_recording_participant_id"), "recording", ["participant_id"], unique=False)
    op.create_index(op.f("ix_recording_superseded_by_id"), "recording", ["superseded_by_id"], unique=False)
    op.create_index(op.f("ix_recording_upload_file_id"), "recording", ["upload_file_id"], unique=False)
    op.create_table(
        "tremor_series",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("participant_id", sa.Integer(), nullable=False),
        sa.Column("upload_file_id", sa.Integer(), nullable=False),
        sa.Column("first_start_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("last_end_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("n", sa.Integer(), nullable=False),
        sa.Column("start_unix_s_f64", sa.LargeBinary(), nullable=False),
        sa.Column("duration_s_f64", sa.LargeBinary(), nullable=False),
        sa.Column("fractions_f32", sa.LargeBinary(), nullable=False),
        sa.Column("any_tremor_f32", sa.LargeBinary(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("removed_at", sa.DateTime(timezone=True), nullable=True),
        sa.CheckConstraint("last_end_at > first_start_at", name=op.f("ck_tremor_series_order")),
        sa.CheckConstraint("n >= 1", name=op.f("ck_tremor_series_minutes")),
        sa.CheckConstraint(
            "octet_length(start_unix_s_f64) = 8 * n and octet_length(duration_s_f64) = 8 * n and octet_length(fractions_f32) = 24 * n and octet_length(any_tremor_f32) = 4 * n",
            name=op.f("ck_tremor_series_length"),
        ),
        sa.ForeignKeyConstraint(["participant_id"], ["participant.id"], name=op.f("fk_tremor_series_participant_id_participant")),
        sa.ForeignKeyConstraint(["upload_file_id"], ["upload_file.id"], name=op.f("fk_tremor_series_upload_file_id_upload_file")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_tremor_series")),
    )
    op.create_index(op.f("ix_tremor_series_upload_file_id"), "tremor_series", ["upload_file_id"], unique=False)
    op.create_index(
        "uq_tremor_series_participant_id_upload_file_id",
        "tremor_series",
        ["participant_id", "upload_file_id"],
        unique=True,
        postgresql_where=sa.text("removed_at is null"),
    )
    op.create_table(
        "counted_time",
        sa.Column("session_id", sa.Integer(), nullable=False),
        sa.Column("recording_id", sa.Integer(), nullable=False),
        sa.Column("start_s", sa.Double(), nullable=False),
        sa.Column("device_side", postgresql.INT4RANGE(), nullable=False),
        sa.Column("span", postgresql.TSTZRANGE(), nullable=False),
        postgresql.ExcludeConstraint(
            (sa.column("device_side"), "&&"),
            (sa.column("span"), "&&"),
            deferrable="True",
            initially="IMMEDIATE",
            using="gist",
            name="counted_time_once",
        ),
        sa.ForeignKeyConstraint(["recording_id"], ["recording.id"], name=op.f("fk_counted_time_recording_id_recording")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_counted_time_session_id_session"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("session_id", "recording_id", "start_s", name=op.f("pk_counted_time")),
    )
    op.create_table(
        "data_query_entry",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("query_id", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("value", sa.Text(), nullable=True),
        sa.Column("entered_by", sa.String(length=254), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("state in ('open', 'answered', 'closed')", name=op.f("ck_data_query_entry_state")),
        sa.CheckConstraint("text <> ''", name=op.f("ck_data_query_entry_text")),
        sa.ForeignKeyConstraint(["query_id"], ["data_query.id"], name=op.f("fk_data_query_entry_query_id_data_query")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_data_query_entry")),
    )
    op.create_index(op.f("ix_data_query_entry_query_id"), "data_query_entry", ["query_id"], unique=False)
    op.create_table(
        "session_segment",
        sa.Column("session_id", sa.Integer(), nullable=False),
        sa.Column("recording_id", sa.Integer(), nullable=False),
        sa.Column("start_s", sa.Double(), nullable=False),
        sa.Column("stop_s", sa.Double(), nullable=False),
        sa.Column("is_control", sa.Boolean(), server_default="true", nullable=False),
        sa.CheckConstraint("stop_s > start_s", name=op.f("ck_session_segment_order")),
        sa.ForeignKeyConstraint(["recording_id"], ["recording.id"], name=op.f("fk_session_segment_recording_id_recording")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_session_segment_session_id_session"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("session_id", "recording_id", "start_s", name=op.f("pk_session_segment")),
    )
    op.create_index("ix_session_segment_recording", "session_segment", ["recording_id"], unique=False)
    op.create_table(
        "trace",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("recording_id", sa.Integer(), nullable=False),
        sa.Column("decode_version", sa.Integer(), nullable=False),
        sa.Column("reading", sa.Integer(), server_default="1", nullable=False),
        sa.Column("stream", sa.String(length=40), nullable=False),
        sa.Column("channel", sa.String(length=80), server_default="", nullable=False),
        sa.Column("unit", sa.String(length=40), nullable=False),
        sa.Column("source", sa.String(length=40), nullable=False),
        sa.Column("dt_s", sa.Double(), nullable=False),
        sa.Column("first_end_s", sa.Double(), nullable=False),
        sa.Column("n", sa.Integer(), nullable=False),
        sa.Column("values_f32", sa.LargeBinary(), nullable=False),
        sa.Column("valid_bits", sa.LargeBinary(), nullable=False),
        sa.Column("details", postgresql.JSONB(astext_type=sa.Text()), server_default="{}", nullable=False),
        sa.CheckConstraint("n >= 0 and dt_s > 0 and octet_length(values_f32) = 4 * n", name=op.f("ck_trace_length")),
        sa.ForeignKeyConstraint(["recording_id"], ["recording.id"], name=op.f("fk_trace_recording_id_recording"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_trace")),
        sa.UniqueConstraint(
            "recording_id",
            "decode_version",
            "reading",
            "stream",
            "channel",
            name=op.f("uq_trace_recording_id_decode_version_reading_stream_channel"),
        ),
    )
    op.create_table(
        "snapshot_session",
        sa.Column("snapshot_id", sa.Integer(), nullable=False),
        sa.Column("session_id", sa.Integer(), nullable=False),
        sa.Column("beta_trace_id", sa.Integer(), nullable=True),
        sa.Column("amplitude_trace_id", sa.Integer(), nullable=True),
        sa.Column("decode_version", sa.Integer(), nullable=True),
        sa.Column("qoc_id", sa.Integer(), nullable=True),
        sa.Column("cdbs_amplitude_ma", sa.Double(), nullable=True),
        sa.Column("steps", sa.Integer(), nullable=True),
        sa.Column("left_out_reason", sa.Text(), nullable=True),
        sa.Column("conditions_id", sa.Integer(), nullable=True),
        sa.Column("hours_since_dose", sa.Double(), nullable=True),
        sa.CheckConstraint("(left_out_reason is null) = (steps is not null)", name=op.f("ck_snapshot_session_in_or_out")),
        sa.ForeignKeyConstraint(["amplitude_trace_id"], ["trace.id"], name=op.f("fk_snapshot_session_amplitude_trace_id_trace")),
        sa.ForeignKeyConstraint(["beta_trace_id"], ["trace.id"], name=op.f("fk_snapshot_session_beta_trace_id_trace")),
        sa.ForeignKeyConstraint(
            ["conditions_id"], ["session_conditions.id"], name=op.f("fk_snapshot_session_conditions_id_session_conditions")
        ),
        sa.ForeignKeyConstraint(["qoc_id"], ["qoc.id"], name=op.f("fk_snapshot_session_qoc_id_qoc")),
        sa.ForeignKeyConstraint(["session_id"], ["session.id"], name=op.f("fk_snapshot_session_session_id_session")),
        sa.ForeignKeyConstraint(
            ["snapshot_id"], ["buffer_snapshot.id"], name=op.f("fk_snapshot_session_snapshot_id_buffer_snapshot"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("snapshot_id", "session_id", name=op.f("pk_snapshot_session")),
    )
    op.create_index(op.f("ix_snapshot_session_session_id"), "snapshot_session", ["session_id"], unique=False)
    op.create_table(
        "port_check",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("policy_id", sa.Integer(), nullable=False),
        sa.Column("bundle_sha256", sa.String(length=64), nullable=False),
        sa.Column("answers_sha256", sa.String(length=64), nullable=False),
        sa.Column("target", sa.String(length=100), nullable=False),
        sa.Column("verdict", sa.String(length=20), nullable=False),
        sa.Column("result", postgresql.JSONB(none_as_null=True, astext_type=sa.Text()), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("created_by", sa.String(length=254), nullable=False),
        sa.CheckConstraint("target <> ''", name=op.f("ck_port_check_target")),
        sa.CheckConstraint("verdict in ('same', 'within', 'not this policy')", name=op.f("ck_port_check_verdict")),
        sa.ForeignKeyConstraint(["answers_sha256"], ["stored_file.sha256"], name=op.f("fk_port_check_answers_sha256_stored_file")),
        sa.ForeignKeyConstraint(["bundle_sha256"], ["stored_file.sha256"], name=op.f("fk_port_check_bundle_sha256_stored_file")),
        sa.ForeignKeyConstraint(["policy_id"], ["policy.id"], name=op.f("fk_port_check_policy_id_policy")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_port_check")),
    )
    op.create_index(op.f("ix_port_check_policy_id"), "port_check", ["policy_id"], unique=False)

    for function in (AUDIT_ROW, AUDIT_NOTE, REFUSE_CHANGE, AUDIT_FIELD, AUDIT_DIGEST, AUDIT_CHAIN, *COUNT_TIME):
        op.execute(function)
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
    for table in NEVER_CHANGED:
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")
    for table in NEVER_EMPTIED:
        op.execute(f"create trigger never_emptied before truncate on {table} for each statement execute function refuse_change()")
    op.execute(NEVER_DELETED)
    op.execute(ENROLLED_AS)
    op.execute(
        "create constraint trigger chained after insert on audit_event deferrable initially deferred for each row execute function audit_chain()"
    )
    for trigger in COUNT_TIME_TRIGGERS:
        op.execute(trigger)
    op.execute("insert into study (code, name) values ('main', 'Main study')")
    op.execute("insert into site (study_id, code, name) select id, 'main', 'Main site' from study where code = 'main'")


def downgrade() -> None:
    """Refuse: nothing comes before the first schema. Raises RuntimeError."""
    raise RuntimeError("this is the first schema; to go back, restore a backup (docs/operations.md)")
