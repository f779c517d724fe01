"""study store"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


AUDIT_FUNCTION = """
create function audit_row() returns trigger language plpgsql as $$
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

REFUSE_FUNCTION = """
create function refuse_change() returns trigger language plpgsql as $$
begin
    raise exception 'rows of % are never changed or deleted', tg_table_name using errcode = 'restrict_violation';
end $$
"""

# frozen copy of app.platform.audit.AUDITED at this revision: table, primary key, columns left out
AUDITED = (
    ("app_user", "id", "password_hash"),
    ("membership", "id", ""),
    ("sign_in", "id", "token_sha256,last_seen_at"),
    ("api_token", "id", "token_sha256,last_used_at"),
    ("study", "id", ""),
    ("site", "id", ""),
    ("participant", "id", ""),
    ("settings_version", "id", ""),
    ("cdbs_amplitude", "id", ""),
    ("device", "id", ""),
    ("visit", "id", ""),
    ("session", "id", ""),
    ("recording", "id", "details"),
    ("session_segment", "session_id,recording_id,start_s", ""),
    ("trace", "id", "values_f32,valid_bits"),
    ("qoc", "id", ""),
    ("stored_file", "sha256", ""),
    ("upload", "id", "report"),
    ("upload_file", "id", "report"),
    ("policy", "id", ""),
    ("buffer_snapshot", "id", ""),
    ("snapshot_session", "snapshot_id,session_id", ""),
    ("evaluation", "id", ""),
    ("estimate", "id", "details"),
    ("plan", "id", ""),
    ("plan_item", "id", ""),
    ("job", "id", "progress,message,updated_at"),
)

# results point at these rows: what they say must stay what it was
NEVER_CHANGED = ("audit_event", "settings_version", "buffer_snapshot", "snapshot_session", "estimate", "qoc")


def upgrade() -> None:
    op.create_table('app_user',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('email', sa.String(length=254), nullable=False),
    sa.Column('name', sa.String(length=200), nullable=False),
    sa.Column('password_hash', sa.String(length=300), nullable=False),
    sa.Column('active', sa.Boolean(), nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.CheckConstraint('email = lower(email)', name=op.f('ck_app_user_email_lower')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_app_user')),
    sa.UniqueConstraint('email', name=op.f('uq_app_user_email'))
    )
    op.create_table('audit_event',
    sa.Column('id', sa.BigInteger(), nullable=False),
    sa.Column('at', sa.DateTime(timezone=True), server_default=sa.text('clock_timestamp()'), nullable=False),
    sa.Column('actor', sa.String(length=254), nullable=False),
    sa.Column('user_id', sa.Integer(), nullable=True),
    sa.Column('request_id', sa.String(length=64), nullable=True),
    sa.Column('action', sa.String(length=10), nullable=False),
    sa.Column('entity', sa.String(length=63), nullable=False),
    sa.Column('entity_id', sa.String(length=200), nullable=False),
    sa.Column('before', postgresql.JSONB(astext_type=sa.Text()), nullable=True),
    sa.Column('after', postgresql.JSONB(astext_type=sa.Text()), nullable=True),
    sa.Column('reason', sa.Text(), nullable=True),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_audit_event'))
    )
    op.create_index(op.f('ix_audit_event_at'), 'audit_event', ['at'], unique=False)
    op.create_index('ix_audit_event_entity', 'audit_event', ['entity', 'entity_id'], unique=False)
    op.create_table('sign_in_attempt',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('email', sa.String(length=254), nullable=False),
    sa.Column('at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_sign_in_attempt'))
    )
    op.create_index('ix_sign_in_attempt_email_at', 'sign_in_attempt', ['email', 'at'], unique=False)
    op.create_table('stored_file',
    sa.Column('sha256', sa.String(length=64), nullable=False),
    sa.Column('size', sa.BigInteger(), nullable=False),
    sa.Column('media_type', sa.String(length=100), nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.CheckConstraint("sha256 ~ '^[0-9a-f]{64}$'", name=op.f('ck_stored_file_sha256')),
    sa.CheckConstraint('size >= 0', name=op.f('ck_stored_file_size')),
    sa.PrimaryKeyConstraint('sha256', name=op.f('pk_stored_file'))
    )
    op.create_table('study',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('code', sa.String(length=40), nullable=False),
    sa.Column('name', sa.String(length=200), nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_study')),
    sa.UniqueConstraint('code', name=op.f('uq_study_code'))
    )
    op.create_table('worker',
    sa.Column('id', sa.String(length=100), nullable=False),
    sa.Column('host', sa.String(length=255), nullable=False),
    sa.Column('pid', sa.Integer(), nullable=False),
    sa.Column('started_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('seen_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_worker'))
    )
    op.create_table('api_token',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('user_id', sa.Integer(), nullable=False),
    sa.Column('name', sa.String(length=100), nullable=False),
    sa.Column('token_sha256', sa.String(length=64), nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('last_used_at', sa.DateTime(timezone=True), nullable=True),
    sa.Column('revoked_at', sa.DateTime(timezone=True), nullable=True),
    sa.ForeignKeyConstraint(['user_id'], ['app_user.id'], name=op.f('fk_api_token_user_id_app_user'), ondelete='CASCADE'),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_api_token')),
    sa.UniqueConstraint('token_sha256', name=op.f('uq_api_token_token_sha256')),
    sa.UniqueConstraint('user_id', 'name', name=op.f('uq_api_token_user_id_name'))
    )
    op.create_index(op.f('ix_api_token_user_id'), 'api_token', ['user_id'], unique=False)
    op.create_table('sign_in',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('token_sha256', sa.String(length=64), nullable=False),
    sa.Column('user_id', sa.Integer(), nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('last_seen_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('ended_at', sa.DateTime(timezone=True), nullable=True),
    sa.ForeignKeyConstraint(['user_id'], ['app_user.id'], name=op.f('fk_sign_in_user_id_app_user'), ondelete='CASCADE'),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_sign_in')),
    sa.UniqueConstraint('token_sha256', name=op.f('uq_sign_in_token_sha256'))
    )
    op.create_index(op.f('ix_sign_in_user_id'), 'sign_in', ['user_id'], unique=False)
    op.create_table('site',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('study_id', sa.Integer(), nullable=False),
    sa.Column('code', sa.String(length=40), nullable=False),
    sa.Column('name', sa.String(length=200), nullable=False),
    sa.ForeignKeyConstraint(['study_id'], ['study.id'], name=op.f('fk_site_study_id_study')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_site')),
    sa.UniqueConstraint('study_id', 'code', name=op.f('uq_site_study_id_code'))
    )
    op.create_table('membership',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('user_id', sa.Integer(), nullable=False),
    sa.Column('study_id', sa.Integer(), nullable=False),
    sa.Column('site_id', sa.Integer(), nullable=True),
    sa.Column('role', sa.String(length=20), nullable=False),
    sa.CheckConstraint("role in ('viewer', 'clinician', 'engineer', 'admin')", name=op.f('ck_membership_role')),
    sa.ForeignKeyConstraint(['site_id'], ['site.id'], name=op.f('fk_membership_site_id_site')),
    sa.ForeignKeyConstraint(['study_id'], ['study.id'], name=op.f('fk_membership_study_id_study')),
    sa.ForeignKeyConstraint(['user_id'], ['app_user.id'], name=op.f('fk_membership_user_id_app_user'), ondelete='CASCADE'),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_membership')),
    sa.UniqueConstraint('user_id', 'study_id', 'site_id', name=op.f('uq_membership_user_id_study_id_site_id'), postgresql_nulls_not_distinct=True)
    )
    op.create_index(op.f('ix_membership_site_id'), 'membership', ['site_id'], unique=False)
    op.create_index(op.f('ix_membership_study_id'), 'membership', ['study_id'], unique=False)
    op.create_index(op.f('ix_membership_user_id'), 'membership', ['user_id'], unique=False)
    op.create_table('participant',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('site_id', sa.Integer(), nullable=False),
    sa.Column('code', sa.String(length=40), nullable=False),
    sa.Column('status', sa.String(length=20), server_default='active', nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.CheckConstraint("status in ('active', 'completed', 'withdrawn')", name=op.f('ck_participant_status')),
    sa.ForeignKeyConstraint(['site_id'], ['site.id'], name=op.f('fk_participant_site_id_site')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_participant')),
    sa.UniqueConstraint('code', name=op.f('uq_participant_code'))
    )
    op.create_index('uq_participant_code_lower', 'participant', [sa.literal_column('lower(code)')], unique=True)
    op.create_index(op.f('ix_participant_site_id'), 'participant', ['site_id'], unique=False)
    op.create_table('device',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('participant_id', sa.Integer(), nullable=False),
    sa.Column('pseudonym', sa.String(length=64), nullable=False),
    sa.Column('kind', sa.String(length=40), nullable=False),
    sa.Column('hemisphere', sa.String(length=5), nullable=True),
    sa.CheckConstraint("hemisphere in ('left', 'right')", name=op.f('ck_device_hemisphere')),
    sa.ForeignKeyConstraint(['participant_id'], ['participant.id'], name=op.f('fk_device_participant_id_participant')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_device')),
    sa.UniqueConstraint('participant_id', 'pseudonym', name=op.f('uq_device_participant_id_pseudonym'))
    )
    op.create_index(op.f('ix_device_participant_id'), 'device', ['participant_id'], unique=False)
    op.create_table('job',
    sa.Column('id', sa.String(length=36), nullable=False),
    sa.Column('participant_id', sa.Integer(), nullable=True),
    sa.Column('kind', sa.String(length=40), nullable=False),
    sa.Column('status', sa.String(length=20), server_default='queued', nullable=False),
    sa.Column('progress', sa.Double(), server_default='0', nullable=False),
    sa.Column('message', sa.Text(), server_default='', nullable=False),
    sa.Column('params', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.Column('result', postgresql.JSONB(astext_type=sa.Text()), nullable=True),
    sa.Column('error', sa.Text(), nullable=True),
    sa.Column('code_version', sa.String(length=80), nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('created_by', sa.String(length=254), nullable=False),
    sa.Column('started_at', sa.DateTime(timezone=True), nullable=True),
    sa.Column('finished_at', sa.DateTime(timezone=True), nullable=True),
    sa.Column('updated_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('cancel_requested_at', sa.DateTime(timezone=True), nullable=True),
    sa.Column('cancel_requested_by', sa.String(length=254), nullable=True),
    sa.CheckConstraint("(finished_at is not null) = (status in ('succeeded', 'failed', 'cancelled'))", name=op.f('ck_job_finished')),
    sa.CheckConstraint("status in ('queued', 'running', 'succeeded', 'failed', 'cancelled')", name=op.f('ck_job_status')),
    sa.CheckConstraint('progress >= 0 and progress <= 1', name=op.f('ck_job_progress')),
    sa.ForeignKeyConstraint(['participant_id'], ['participant.id'], name=op.f('fk_job_participant_id_participant')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_job'))
    )
    op.create_index(op.f('ix_job_kind'), 'job', ['kind'], unique=False)
    op.create_index(op.f('ix_job_participant_id'), 'job', ['participant_id'], unique=False)
    op.create_table('settings_version',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('participant_id', sa.Integer(), nullable=False),
    sa.Column('version', sa.Integer(), nullable=False),
    sa.Column('xi_beta', sa.Double(), nullable=True),
    sa.Column('beta_unit', sa.String(length=40), nullable=True),
    sa.Column('beta_source', sa.String(length=40), nullable=True),
    sa.Column('window', sa.Integer(), nullable=False),
    sa.Column('period_s', sa.Double(), nullable=False),
    sa.Column('r_a', sa.Double(), nullable=False),
    sa.Column('r_b', sa.Double(), nullable=False),
    sa.Column('c1', sa.Double(), nullable=False),
    sa.Column('c2', sa.Double(), nullable=False),
    sa.Column('c3', sa.Double(), nullable=False),
    sa.Column('c4', sa.Double(), nullable=False),
    sa.Column('gamma', sa.Double(), nullable=False),
    sa.Column('lower_bound', sa.Double(), nullable=False),
    sa.Column('tremor_as_fraction', sa.Boolean(), nullable=False),
    sa.Column('cdbs_amplitude_ma', sa.Double(), nullable=True),
    sa.Column('beta_low_hz', sa.Double(), nullable=False),
    sa.Column('beta_high_hz', sa.Double(), nullable=False),
    sa.Column('min_valid_fraction', sa.Double(), nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('created_by', sa.String(length=254), nullable=False),
    sa.Column('reason', sa.Text(), nullable=True),
    sa.CheckConstraint('"window" >= 1 and period_s > 0', name=op.f('ck_settings_version_window')),
    sa.CheckConstraint('beta_low_hz > 0 and beta_low_hz < beta_high_hz', name=op.f('ck_settings_version_beta_band')),
    sa.CheckConstraint('c1 >= 0 and c2 >= 0 and c3 >= 0 and c4 >= 0', name=op.f('ck_settings_version_weights')),
    sa.CheckConstraint('cdbs_amplitude_ma > 0', name=op.f('ck_settings_version_cdbs_amplitude')),
    sa.CheckConstraint('gamma >= 0 and gamma < 1', name=op.f('ck_settings_version_gamma')),
    sa.CheckConstraint('lower_bound >= 0 and lower_bound < 1', name=op.f('ck_settings_version_lower_bound')),
    sa.CheckConstraint('min_valid_fraction > 0 and min_valid_fraction <= 1', name=op.f('ck_settings_version_min_valid')),
    sa.CheckConstraint('r_a >= r_b', name=op.f('ck_settings_version_rewards')),
    sa.ForeignKeyConstraint(['participant_id'], ['participant.id'], name=op.f('fk_settings_version_participant_id_participant')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_settings_version')),
    sa.UniqueConstraint('participant_id', 'version', name=op.f('uq_settings_version_participant_id_version'))
    )
    op.create_index(op.f('ix_settings_version_participant_id'), 'settings_version', ['participant_id'], unique=False)
    op.create_table('visit',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('participant_id', sa.Integer(), nullable=False),
    sa.Column('number', sa.Integer(), nullable=False),
    sa.Column('date', sa.Date(), nullable=True),
    sa.Column('note', sa.Text(), server_default='', nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.CheckConstraint('number >= 1', name=op.f('ck_visit_number')),
    sa.ForeignKeyConstraint(['participant_id'], ['participant.id'], name=op.f('fk_visit_participant_id_participant')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_visit')),
    sa.UniqueConstraint('participant_id', 'number', name=op.f('uq_visit_participant_id_number'))
    )
    op.create_index(op.f('ix_visit_participant_id'), 'visit', ['participant_id'], unique=False)
    op.create_table('buffer_snapshot',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('participant_id', sa.Integer(), nullable=False),
    sa.Column('settings_version_id', sa.Integer(), nullable=False),
    sa.Column('pins_sha256', sa.String(length=64), nullable=False),
    sa.Column('file_sha256', sa.String(length=64), nullable=False),
    sa.Column('sessions', sa.Integer(), nullable=False),
    sa.Column('steps', sa.Integer(), nullable=False),
    sa.Column('median_steps', sa.Integer(), nullable=False),
    sa.Column('beta_unit', sa.String(length=40), nullable=False),
    sa.Column('beta_source', sa.String(length=40), nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('created_by', sa.String(length=254), nullable=False),
    sa.CheckConstraint('sessions >= 1 and steps >= 1', name=op.f('ck_buffer_snapshot_not_empty')),
    sa.ForeignKeyConstraint(['file_sha256'], ['stored_file.sha256'], name=op.f('fk_buffer_snapshot_file_sha256_stored_file')),
    sa.ForeignKeyConstraint(['participant_id'], ['participant.id'], name=op.f('fk_buffer_snapshot_participant_id_participant')),
    sa.ForeignKeyConstraint(['settings_version_id'], ['settings_version.id'], name=op.f('fk_buffer_snapshot_settings_version_id_settings_version')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_buffer_snapshot')),
    sa.UniqueConstraint('participant_id', 'pins_sha256', name=op.f('uq_buffer_snapshot_participant_id_pins_sha256'))
    )
    op.create_index(op.f('ix_buffer_snapshot_participant_id'), 'buffer_snapshot', ['participant_id'], unique=False)
    op.create_table('cdbs_amplitude',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('visit_id', sa.Integer(), nullable=False),
    sa.Column('hemisphere', sa.String(length=5), nullable=False),
    sa.Column('program', sa.SmallInteger(), nullable=False),
    sa.Column('amplitude_ma', sa.Double(), nullable=False),
    sa.CheckConstraint("hemisphere in ('left', 'right')", name=op.f('ck_cdbs_amplitude_hemisphere')),
    sa.CheckConstraint('amplitude_ma > 0', name=op.f('ck_cdbs_amplitude_amplitude')),
    sa.CheckConstraint('program between 0 and 3', name=op.f('ck_cdbs_amplitude_program')),
    sa.ForeignKeyConstraint(['visit_id'], ['visit.id'], name=op.f('fk_cdbs_amplitude_visit_id_visit')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_cdbs_amplitude')),
    sa.UniqueConstraint('visit_id', 'hemisphere', 'program', name=op.f('uq_cdbs_amplitude_visit_id_hemisphere_program'))
    )
    op.create_index(op.f('ix_cdbs_amplitude_visit_id'), 'cdbs_amplitude', ['visit_id'], unique=False)
    op.create_table('job_event',
    sa.Column('id', sa.BigInteger(), nullable=False),
    sa.Column('job_id', sa.String(length=36), nullable=False),
    sa.Column('step_key', sa.String(length=100), nullable=True),
    sa.Column('kind', sa.String(length=20), nullable=False),
    sa.Column('data', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.Column('at', sa.DateTime(timezone=True), server_default=sa.text('clock_timestamp()'), nullable=False),
    sa.ForeignKeyConstraint(['job_id'], ['job.id'], name=op.f('fk_job_event_job_id_job'), ondelete='CASCADE'),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_job_event'))
    )
    op.create_index('ix_job_event_job_id_id', 'job_event', ['job_id', 'id'], unique=False)
    op.create_table('job_step',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('job_id', sa.String(length=36), nullable=False),
    sa.Column('key', sa.String(length=100), nullable=False),
    sa.Column('title', sa.String(length=200), nullable=False),
    sa.Column('position', sa.Integer(), nullable=False),
    sa.Column('weight', sa.Double(), server_default='1', nullable=False),
    sa.Column('status', sa.String(length=20), server_default='queued', nullable=False),
    sa.Column('progress', sa.Double(), server_default='0', nullable=False),
    sa.Column('message', sa.Text(), server_default='', nullable=False),
    sa.Column('attempts', sa.Integer(), server_default='0', nullable=False),
    sa.Column('worker', sa.String(length=100), nullable=True),
    sa.Column('result', postgresql.JSONB(astext_type=sa.Text()), nullable=True),
    sa.Column('started_at', sa.DateTime(timezone=True), nullable=True),
    sa.Column('finished_at', sa.DateTime(timezone=True), nullable=True),
    sa.CheckConstraint("status in ('queued', 'running', 'succeeded', 'failed', 'cancelled')", name=op.f('ck_job_step_status')),
    sa.CheckConstraint('progress >= 0 and progress <= 1', name=op.f('ck_job_step_progress')),
    sa.ForeignKeyConstraint(['job_id'], ['job.id'], name=op.f('fk_job_step_job_id_job'), ondelete='CASCADE'),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_job_step')),
    sa.UniqueConstraint('job_id', 'key', name=op.f('uq_job_step_job_id_key'))
    )
    op.create_index(op.f('ix_job_step_job_id'), 'job_step', ['job_id'], unique=False)
    op.create_table('upload',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('participant_id', sa.Integer(), nullable=False),
    sa.Column('visit_id', sa.Integer(), nullable=True),
    sa.Column('status', sa.String(length=20), server_default='received', nullable=False),
    sa.Column('stated', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.Column('report', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('created_by', sa.String(length=254), nullable=False),
    sa.CheckConstraint("status in ('received', 'decoded', 'failed')", name=op.f('ck_upload_status')),
    sa.ForeignKeyConstraint(['participant_id'], ['participant.id'], name=op.f('fk_upload_participant_id_participant')),
    sa.ForeignKeyConstraint(['visit_id'], ['visit.id'], name=op.f('fk_upload_visit_id_visit')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_upload'))
    )
    op.create_index(op.f('ix_upload_participant_id'), 'upload', ['participant_id'], unique=False)
    op.create_index(op.f('ix_upload_visit_id'), 'upload', ['visit_id'], unique=False)
    op.create_table('evaluation',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('participant_id', sa.Integer(), nullable=False),
    sa.Column('snapshot_id', sa.Integer(), nullable=False),
    sa.Column('settings_version_id', sa.Integer(), nullable=False),
    sa.Column('job_id', sa.String(length=36), nullable=True),
    sa.Column('horizon_steps', sa.Integer(), nullable=False),
    sa.Column('gamma', sa.Double(), nullable=False),
    sa.Column('default_method', sa.String(length=40), nullable=False),
    sa.Column('config', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.Column('diagnostics', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.Column('code_version', sa.String(length=80), nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('created_by', sa.String(length=254), nullable=False),
    sa.CheckConstraint('horizon_steps >= 1', name=op.f('ck_evaluation_horizon')),
    sa.ForeignKeyConstraint(['job_id'], ['job.id'], name=op.f('fk_evaluation_job_id_job')),
    sa.ForeignKeyConstraint(['participant_id'], ['participant.id'], name=op.f('fk_evaluation_participant_id_participant')),
    sa.ForeignKeyConstraint(['settings_version_id'], ['settings_version.id'], name=op.f('fk_evaluation_settings_version_id_settings_version')),
    sa.ForeignKeyConstraint(['snapshot_id'], ['buffer_snapshot.id'], name=op.f('fk_evaluation_snapshot_id_buffer_snapshot')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_evaluation')),
    sa.UniqueConstraint('job_id', name=op.f('uq_evaluation_job_id'))
    )
    op.create_index(op.f('ix_evaluation_participant_id'), 'evaluation', ['participant_id'], unique=False)
    op.create_table('policy',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('participant_id', sa.Integer(), nullable=False),
    sa.Column('name', sa.String(length=100), nullable=False),
    sa.Column('kind', sa.String(length=20), nullable=False),
    sa.Column('algorithm', sa.String(length=40), nullable=False),
    sa.Column('teacher_id', sa.Integer(), nullable=True),
    sa.Column('parent_id', sa.Integer(), nullable=True),
    sa.Column('snapshot_id', sa.Integer(), nullable=True),
    sa.Column('settings_version_id', sa.Integer(), nullable=False),
    sa.Column('job_id', sa.String(length=36), nullable=True),
    sa.Column('job_step', sa.String(length=100), nullable=True),
    sa.Column('config', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.Column('seed', sa.Integer(), nullable=True),
    sa.Column('onnx_sha256', sa.String(length=64), nullable=False),
    sa.Column('checkpoint_sha256', sa.String(length=64), nullable=True),
    sa.Column('metrics', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.Column('code_version', sa.String(length=80), nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('created_by', sa.String(length=254), nullable=False),
    sa.Column('retired_reason', sa.Text(), nullable=True),
    sa.CheckConstraint("(kind = 'distilled') = (teacher_id is not null)", name=op.f('ck_policy_teacher')),
    sa.CheckConstraint("kind in ('trained', 'distilled', 'external', 'baseline')", name=op.f('ck_policy_kind')),
    sa.CheckConstraint("kind not in ('trained', 'distilled') or snapshot_id is not null", name=op.f('ck_policy_snapshot')),
    sa.ForeignKeyConstraint(['checkpoint_sha256'], ['stored_file.sha256'], name=op.f('fk_policy_checkpoint_sha256_stored_file')),
    sa.ForeignKeyConstraint(['job_id'], ['job.id'], name=op.f('fk_policy_job_id_job')),
    sa.ForeignKeyConstraint(['onnx_sha256'], ['stored_file.sha256'], name=op.f('fk_policy_onnx_sha256_stored_file')),
    sa.ForeignKeyConstraint(['parent_id'], ['policy.id'], name=op.f('fk_policy_parent_id_policy')),
    sa.ForeignKeyConstraint(['participant_id'], ['participant.id'], name=op.f('fk_policy_participant_id_participant')),
    sa.ForeignKeyConstraint(['settings_version_id'], ['settings_version.id'], name=op.f('fk_policy_settings_version_id_settings_version')),
    sa.ForeignKeyConstraint(['snapshot_id'], ['buffer_snapshot.id'], name=op.f('fk_policy_snapshot_id_buffer_snapshot')),
    sa.ForeignKeyConstraint(['teacher_id'], ['policy.id'], name=op.f('fk_policy_teacher_id_policy')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_policy')),
    sa.UniqueConstraint('job_id', 'job_step', name=op.f('uq_policy_job_id_job_step')),
    sa.UniqueConstraint('participant_id', 'name', name=op.f('uq_policy_participant_id_name'))
    )
    op.create_index(op.f('ix_policy_job_id'), 'policy', ['job_id'], unique=False)
    op.create_index(op.f('ix_policy_participant_id'), 'policy', ['participant_id'], unique=False)
    op.create_table('upload_file',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('upload_id', sa.Integer(), nullable=False),
    sa.Column('participant_id', sa.Integer(), nullable=False),
    sa.Column('name', sa.String(length=255), nullable=False),
    sa.Column('kind', sa.String(length=40), server_default='unknown', nullable=False),
    sa.Column('size', sa.BigInteger(), nullable=False),
    sa.Column('original_sha256', sa.String(length=64), nullable=False),
    sa.Column('stored_sha256', sa.String(length=64), nullable=True),
    sa.Column('quarantine_sha256', sa.String(length=64), nullable=True),
    sa.Column('redactor_version', sa.Integer(), nullable=True),
    sa.Column('status', sa.String(length=20), server_default='received', nullable=False),
    sa.Column('report', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.CheckConstraint("status in ('received', 'decoded', 'failed')", name=op.f('ck_upload_file_status')),
    sa.ForeignKeyConstraint(['participant_id'], ['participant.id'], name=op.f('fk_upload_file_participant_id_participant')),
    sa.ForeignKeyConstraint(['quarantine_sha256'], ['stored_file.sha256'], name=op.f('fk_upload_file_quarantine_sha256_stored_file')),
    sa.ForeignKeyConstraint(['stored_sha256'], ['stored_file.sha256'], name=op.f('fk_upload_file_stored_sha256_stored_file')),
    sa.ForeignKeyConstraint(['upload_id'], ['upload.id'], name=op.f('fk_upload_file_upload_id_upload')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_upload_file'))
    )
    op.create_index(op.f('ix_upload_file_original_sha256'), 'upload_file', ['original_sha256'], unique=False)
    op.create_index(op.f('ix_upload_file_participant_id'), 'upload_file', ['participant_id'], unique=False)
    op.create_index(op.f('ix_upload_file_upload_id'), 'upload_file', ['upload_id'], unique=False)
    op.create_index('uq_upload_file_participant_original', 'upload_file', ['participant_id', 'original_sha256'], unique=True, postgresql_where="status = 'decoded'")
    op.create_table('estimate',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('evaluation_id', sa.Integer(), nullable=False),
    sa.Column('policy_id', sa.Integer(), nullable=False),
    sa.Column('method', sa.String(length=40), nullable=False),
    sa.Column('value', sa.Double(), nullable=False),
    sa.Column('low', sa.Double(), nullable=False),
    sa.Column('high', sa.Double(), nullable=False),
    sa.Column('level', sa.Double(), nullable=False),
    sa.Column('standard_error', sa.Double(), nullable=True),
    sa.Column('supported', sa.Boolean(), nullable=False),
    sa.Column('flags', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.Column('predicted', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.Column('details', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.CheckConstraint('level > 0 and level < 1', name=op.f('ck_estimate_level')),
    sa.CheckConstraint('low <= value and value <= high', name=op.f('ck_estimate_interval')),
    sa.ForeignKeyConstraint(['evaluation_id'], ['evaluation.id'], name=op.f('fk_estimate_evaluation_id_evaluation'), ondelete='CASCADE'),
    sa.ForeignKeyConstraint(['policy_id'], ['policy.id'], name=op.f('fk_estimate_policy_id_policy')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_estimate')),
    sa.UniqueConstraint('evaluation_id', 'policy_id', 'method', name=op.f('uq_estimate_evaluation_id_policy_id_method'))
    )
    op.create_index(op.f('ix_estimate_policy_id'), 'estimate', ['policy_id'], unique=False)
    op.create_table('plan',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('visit_id', sa.Integer(), nullable=False),
    sa.Column('evaluation_id', sa.Integer(), nullable=True),
    sa.Column('status', sa.String(length=20), server_default='draft', nullable=False),
    sa.Column('seed', sa.Integer(), nullable=False),
    sa.Column('rules', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.Column('note', sa.Text(), server_default='', nullable=False),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.Column('created_by', sa.String(length=254), nullable=False),
    sa.Column('approved_at', sa.DateTime(timezone=True), nullable=True),
    sa.Column('approved_by', sa.String(length=254), nullable=True),
    sa.CheckConstraint("(status = 'draft') = (approved_at is null) or status = 'superseded'", name=op.f('ck_plan_approval')),
    sa.CheckConstraint("status in ('draft', 'approved', 'superseded')", name=op.f('ck_plan_status')),
    sa.ForeignKeyConstraint(['evaluation_id'], ['evaluation.id'], name=op.f('fk_plan_evaluation_id_evaluation')),
    sa.ForeignKeyConstraint(['visit_id'], ['visit.id'], name=op.f('fk_plan_visit_id_visit')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_plan'))
    )
    op.create_index(op.f('ix_plan_visit_id'), 'plan', ['visit_id'], unique=False)
    op.create_index('uq_plan_visit_live', 'plan', ['visit_id'], unique=True, postgresql_where="status <> 'superseded'")
    op.create_table('recording',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('participant_id', sa.Integer(), nullable=False),
    sa.Column('device_id', sa.Integer(), nullable=False),
    sa.Column('upload_file_id', sa.Integer(), nullable=True),
    sa.Column('fingerprint', sa.String(length=64), nullable=False),
    sa.Column('hemisphere', sa.String(length=5), nullable=True),
    sa.Column('clock', sa.String(length=10), nullable=False),
    sa.Column('started_at', sa.DateTime(timezone=True), nullable=True),
    sa.Column('duration_s', sa.Double(), nullable=False),
    sa.Column('details', postgresql.JSONB(astext_type=sa.Text()), nullable=False),
    sa.CheckConstraint("clock in ('device', 'pc', 'table')", name=op.f('ck_recording_clock')),
    sa.CheckConstraint("started_at >= '1990-01-01Z' and started_at < '2201-01-01Z'", name=op.f('ck_recording_started_at')),
    sa.CheckConstraint("hemisphere in ('left', 'right')", name=op.f('ck_recording_hemisphere')),
    sa.ForeignKeyConstraint(['device_id'], ['device.id'], name=op.f('fk_recording_device_id_device')),
    sa.ForeignKeyConstraint(['participant_id'], ['participant.id'], name=op.f('fk_recording_participant_id_participant')),
    sa.ForeignKeyConstraint(['upload_file_id'], ['upload_file.id'], name=op.f('fk_recording_upload_file_id_upload_file')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_recording')),
    sa.UniqueConstraint('participant_id', 'fingerprint', name=op.f('uq_recording_participant_id_fingerprint'))
    )
    op.create_index(op.f('ix_recording_device_id'), 'recording', ['device_id'], unique=False)
    op.create_index(op.f('ix_recording_participant_id'), 'recording', ['participant_id'], unique=False)
    op.create_index(op.f('ix_recording_upload_file_id'), 'recording', ['upload_file_id'], unique=False)
    op.create_table('session',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('visit_id', sa.Integer(), nullable=False),
    sa.Column('ordinal', sa.Integer(), nullable=False),
    sa.Column('controller', sa.String(length=20), nullable=False),
    sa.Column('policy_id', sa.Integer(), nullable=True),
    sa.Column('hemisphere', sa.String(length=5), nullable=True),
    sa.Column('status', sa.String(length=20), server_default='confirmed', nullable=False),
    sa.Column('started_at', sa.DateTime(timezone=True), nullable=True),
    sa.Column('duration_s', sa.Double(), nullable=False),
    sa.Column('control_stream', sa.String(length=40), server_default='beta', nullable=False),
    sa.Column('control_channel', sa.String(length=80), nullable=True),
    sa.Column('excluded_reason', sa.Text(), nullable=True),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.CheckConstraint("controller in ('cdbs', 'rl', 'distilled', 'no_dbs', 'random', 'other')", name=op.f('ck_session_controller')),
    sa.CheckConstraint("excluded_reason is null or excluded_reason <> ''", name=op.f('ck_session_excluded_reason')),
    sa.CheckConstraint("started_at >= '1990-01-01Z' and started_at < '2201-01-01Z'", name=op.f('ck_session_started_at')),
    sa.CheckConstraint("hemisphere in ('left', 'right')", name=op.f('ck_session_hemisphere')),
    sa.CheckConstraint("status in ('proposed', 'confirmed')", name=op.f('ck_session_status')),
    sa.CheckConstraint('duration_s >= 0', name=op.f('ck_session_duration')),
    sa.ForeignKeyConstraint(['policy_id'], ['policy.id'], name=op.f('fk_session_policy_id_policy')),
    sa.ForeignKeyConstraint(['visit_id'], ['visit.id'], name=op.f('fk_session_visit_id_visit')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_session')),
    sa.UniqueConstraint('visit_id', 'ordinal', name=op.f('uq_session_visit_id_ordinal'))
    )
    op.create_index(op.f('ix_session_policy_id'), 'session', ['policy_id'], unique=False)
    op.create_index(op.f('ix_session_visit_id'), 'session', ['visit_id'], unique=False)
    op.create_table('plan_item',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('plan_id', sa.Integer(), nullable=False),
    sa.Column('position', sa.Integer(), nullable=False),
    sa.Column('controller', sa.String(length=20), nullable=False),
    sa.Column('policy_id', sa.Integer(), nullable=True),
    sa.Column('minutes', sa.Double(), nullable=False),
    sa.Column('washout_minutes', sa.Double(), nullable=False),
    sa.Column('note', sa.Text(), server_default='', nullable=False),
    sa.CheckConstraint("controller in ('cdbs', 'rl', 'distilled', 'no_dbs', 'random', 'other')", name=op.f('ck_plan_item_controller')),
    sa.CheckConstraint('minutes > 0 and washout_minutes >= 0', name=op.f('ck_plan_item_minutes')),
    sa.ForeignKeyConstraint(['plan_id'], ['plan.id'], name=op.f('fk_plan_item_plan_id_plan'), ondelete='CASCADE'),
    sa.ForeignKeyConstraint(['policy_id'], ['policy.id'], name=op.f('fk_plan_item_policy_id_policy')),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_plan_item')),
    sa.UniqueConstraint('plan_id', 'position', name=op.f('uq_plan_item_plan_id_position'))
    )
    op.create_table('qoc',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('session_id', sa.Integer(), nullable=False),
    sa.Column('revision', sa.Integer(), nullable=False),
    sa.Column('grasp_hz', sa.Double(), nullable=True),
    sa.Column('rating', sa.SmallInteger(), nullable=True),
    sa.Column('tremor_percent', sa.Double(), nullable=True),
    sa.Column('entered_by', sa.String(length=254), nullable=False),
    sa.Column('reason', sa.Text(), nullable=True),
    sa.Column('created_at', sa.DateTime(timezone=True), server_default=sa.text('now()'), nullable=False),
    sa.CheckConstraint('grasp_hz >= 0 and grasp_hz < 20', name=op.f('ck_qoc_grasp')),
    sa.CheckConstraint('rating between 1 and 10', name=op.f('ck_qoc_rating')),
    sa.CheckConstraint('tremor_percent between 0 and 100', name=op.f('ck_qoc_tremor')),
    sa.ForeignKeyConstraint(['session_id'], ['session.id'], name=op.f('fk_qoc_session_id_session'), ondelete='CASCADE'),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_qoc')),
    sa.UniqueConstraint('session_id', 'revision', name=op.f('uq_qoc_session_id_revision'))
    )
    op.create_index(op.f('ix_qoc_session_id'), 'qoc', ['session_id'], unique=False)
    op.create_table('session_segment',
    sa.Column('session_id', sa.Integer(), nullable=False),
    sa.Column('recording_id', sa.Integer(), nullable=False),
    sa.Column('start_s', sa.Double(), nullable=False),
    sa.Column('stop_s', sa.Double(), nullable=False),
    sa.Column('is_control', sa.Boolean(), server_default='true', nullable=False),
    sa.CheckConstraint('stop_s > start_s', name=op.f('ck_session_segment_order')),
    sa.ForeignKeyConstraint(['recording_id'], ['recording.id'], name=op.f('fk_session_segment_recording_id_recording')),
    sa.ForeignKeyConstraint(['session_id'], ['session.id'], name=op.f('fk_session_segment_session_id_session'), ondelete='CASCADE'),
    sa.PrimaryKeyConstraint('session_id', 'recording_id', 'start_s', name=op.f('pk_session_segment'))
    )
    op.create_index('ix_session_segment_recording', 'session_segment', ['recording_id'], unique=False)
    op.create_table('trace',
    sa.Column('id', sa.Integer(), nullable=False),
    sa.Column('recording_id', sa.Integer(), nullable=False),
    sa.Column('decode_version', sa.Integer(), nullable=False),
    sa.Column('stream', sa.String(length=40), nullable=False),
    sa.Column('channel', sa.String(length=80), server_default='', nullable=False),
    sa.Column('unit', sa.String(length=40), nullable=False),
    sa.Column('source', sa.String(length=40), nullable=False),
    sa.Column('dt_s', sa.Double(), nullable=False),
    sa.Column('first_end_s', sa.Double(), nullable=False),
    sa.Column('n', sa.Integer(), nullable=False),
    sa.Column('values_f32', sa.LargeBinary(), nullable=False),
    sa.Column('valid_bits', sa.LargeBinary(), nullable=False),
    sa.Column('details', postgresql.JSONB(astext_type=sa.Text()), server_default='{}', nullable=False),
    sa.CheckConstraint('n >= 0 and dt_s > 0 and octet_length(values_f32) = 4 * n', name=op.f('ck_trace_length')),
    sa.ForeignKeyConstraint(['recording_id'], ['recording.id'], name=op.f('fk_trace_recording_id_recording'), ondelete='CASCADE'),
    sa.PrimaryKeyConstraint('id', name=op.f('pk_trace')),
    sa.UniqueConstraint('recording_id', 'decode_version', 'stream', 'channel', name=op.f('uq_trace_recording_id_decode_version_stream_channel'))
    )
    op.create_table('snapshot_session',
    sa.Column('snapshot_id', sa.Integer(), nullable=False),
    sa.Column('session_id', sa.Integer(), nullable=False),
    sa.Column('beta_trace_id', sa.Integer(), nullable=True),
    sa.Column('amplitude_trace_id', sa.Integer(), nullable=True),
    sa.Column('decode_version', sa.Integer(), nullable=True),
    sa.Column('qoc_id', sa.Integer(), nullable=True),
    sa.Column('cdbs_amplitude_ma', sa.Double(), nullable=True),
    sa.Column('steps', sa.Integer(), nullable=True),
    sa.Column('left_out_reason', sa.Text(), nullable=True),
    sa.CheckConstraint('(left_out_reason is null) = (steps is not null)', name=op.f('ck_snapshot_session_in_or_out')),
    sa.ForeignKeyConstraint(['amplitude_trace_id'], ['trace.id'], name=op.f('fk_snapshot_session_amplitude_trace_id_trace')),
    sa.ForeignKeyConstraint(['beta_trace_id'], ['trace.id'], name=op.f('fk_snapshot_session_beta_trace_id_trace')),
    sa.ForeignKeyConstraint(['qoc_id'], ['qoc.id'], name=op.f('fk_snapshot_session_qoc_id_qoc')),
    sa.ForeignKeyConstraint(['session_id'], ['session.id'], name=op.f('fk_snapshot_session_session_id_session')),
    sa.ForeignKeyConstraint(['snapshot_id'], ['buffer_snapshot.id'], name=op.f('fk_snapshot_session_snapshot_id_buffer_snapshot'), ondelete='CASCADE'),
    sa.PrimaryKeyConstraint('snapshot_id', 'session_id', name=op.f('pk_snapshot_session'))
    )
    op.create_index(op.f('ix_snapshot_session_session_id'), 'snapshot_session', ['session_id'], unique=False)

    op.execute(AUDIT_FUNCTION)
    op.execute(REFUSE_FUNCTION)
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
    for table in NEVER_CHANGED:
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")
    op.execute("create trigger never_emptied before truncate on audit_event for each statement execute function refuse_change()")
    op.execute("insert into study (code, name) values ('main', 'Main study')")
    op.execute("insert into site (study_id, code, name) select id, 'main', 'Main site' from study where code = 'main'")


def downgrade() -> None:
    for table, _, _ in AUDITED:
        op.execute(f"drop trigger audit on {table}")
    op.drop_index(op.f('ix_snapshot_session_session_id'), table_name='snapshot_session')
    op.drop_table('snapshot_session')
    op.drop_table('trace')
    op.drop_index('ix_session_segment_recording', table_name='session_segment')
    op.drop_table('session_segment')
    op.drop_index(op.f('ix_qoc_session_id'), table_name='qoc')
    op.drop_table('qoc')
    op.drop_table('plan_item')
    op.drop_index(op.f('ix_session_visit_id'), table_name='session')
    op.drop_index(op.f('ix_session_policy_id'), table_name='session')
    op.drop_table('session')
    op.drop_index(op.f('ix_recording_upload_file_id'), table_name='recording')
    op.drop_index(op.f('ix_recording_participant_id'), table_name='recording')
    op.drop_index(op.f('ix_recording_device_id'), table_name='recording')
    op.drop_table('recording')
    op.drop_index('uq_plan_visit_live', table_name='plan', postgresql_where="status <> 'superseded'")
    op.drop_index(op.f('ix_plan_visit_id'), table_name='plan')
    op.drop_table('plan')
    op.drop_index(op.f('ix_estimate_policy_id'), table_name='estimate')
    op.drop_table('estimate')
    op.drop_index('uq_upload_file_participant_original', table_name='upload_file', postgresql_where="status = 'decoded'")
    op.drop_index(op.f('ix_upload_file_upload_id'), table_name='upload_file')
    op.drop_index(op.f('ix_upload_file_participant_id'), table_name='upload_file')
    op.drop_index(op.f('ix_upload_file_original_sha256'), table_name='upload_file')
    op.drop_table('upload_file')
    op.drop_index(op.f('ix_policy_participant_id'), table_name='policy')
    op.drop_index(op.f('ix_policy_job_id'), table_name='policy')
    op.drop_table('policy')
    op.drop_index(op.f('ix_evaluation_participant_id'), table_name='evaluation')
    op.drop_table('evaluation')
    op.drop_index(op.f('ix_upload_visit_id'), table_name='upload')
    op.drop_index(op.f('ix_upload_participant_id'), table_name='upload')
    op.drop_table('upload')
    op.drop_index(op.f('ix_job_step_job_id'), table_name='job_step')
    op.drop_table('job_step')
    op.drop_index('ix_job_event_job_id_id', table_name='job_event')
    op.drop_table('job_event')
    op.drop_index(op.f('ix_cdbs_amplitude_visit_id'), table_name='cdbs_amplitude')
    op.drop_table('cdbs_amplitude')
    op.drop_index(op.f('ix_buffer_snapshot_participant_id'), table_name='buffer_snapshot')
    op.drop_table('buffer_snapshot')
    op.drop_index(op.f('ix_visit_participant_id'), table_name='visit')
    op.drop_table('visit')
    op.drop_index(op.f('ix_settings_version_participant_id'), table_name='settings_version')
    op.drop_table('settings_version')
    op.drop_index(op.f('ix_job_participant_id'), table_name='job')
    op.drop_index(op.f('ix_job_kind'), table_name='job')
    op.drop_table('job')
    op.drop_index(op.f('ix_device_participant_id'), table_name='device')
    op.drop_table('device')
    op.drop_index(op.f('ix_participant_site_id'), table_name='participant')
    op.drop_table('participant')
    op.drop_index(op.f('ix_membership_user_id'), table_name='membership')
    op.drop_index(op.f('ix_membership_study_id'), table_name='membership')
    op.drop_index(op.f('ix_membership_site_id'), table_name='membership')
    op.drop_table('membership')
    op.drop_table('site')
    op.drop_index(op.f('ix_sign_in_user_id'), table_name='sign_in')
    op.drop_table('sign_in')
    op.drop_index(op.f('ix_api_token_user_id'), table_name='api_token')
    op.drop_table('api_token')
    op.drop_table('worker')
    op.drop_table('study')
    op.drop_table('stored_file')
    op.drop_index('ix_sign_in_attempt_email_at', table_name='sign_in_attempt')
    op.drop_table('sign_in_attempt')
    op.drop_index('ix_audit_event_entity', table_name='audit_event')
    op.drop_index(op.f('ix_audit_event_at'), table_name='audit_event')
    op.drop_table('audit_event')
    op.drop_table('app_user')
    op.execute("drop function audit_row")
    op.execute("drop function refuse_change")
