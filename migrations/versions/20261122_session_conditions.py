"""What each session ran under, in a row of its own; of the sessions so far what was in force at the time, marked as assumed."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

# frozen copy of app.platform.audit.AUDITED for the table of this revision: table, primary key, columns left out
AUDITED = (("session_conditions", "id", ""),)
NEVER_CHANGED = ("session_conditions",)
LEAD_ROWS = 60


def upgrade() -> None:
    op.create_table(
        "session_conditions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("session_id", sa.Integer(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("origin", sa.String(length=10), nullable=False),
        sa.Column("lower_bound", sa.Float(), nullable=False),
        sa.Column("window", sa.Integer(), nullable=False),
        sa.Column("period_s", sa.Float(), nullable=False),
        sa.Column("xi_beta", sa.Float(), nullable=True),
        sa.Column("min_ma", sa.Float(), nullable=True),
        sa.Column("max_ma", sa.Float(), nullable=True),
        sa.Column("seed", sa.BigInteger(), nullable=True),
        sa.Column("design", sa.String(length=40), nullable=True),
        sa.Column("design_parameters", postgresql.JSONB(astext_type=sa.Text()), server_default="{}", nullable=False),
        sa.Column("lead_amplitude_ma", sa.Float(), nullable=True),
        sa.Column("cdbs_amplitude_ma", sa.Float(), nullable=True),
        sa.Column("programming", postgresql.JSONB(astext_type=sa.Text()), server_default="[]", nullable=False),
        sa.Column("entered_by", sa.String(length=254), nullable=False),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.CheckConstraint("origin in ('stated', 'settings', 'assumed')", name=op.f("ck_session_conditions_origin")),
        sa.CheckConstraint("lower_bound >= 0 and lower_bound < 1", name=op.f("ck_session_conditions_lower_bound")),
        sa.CheckConstraint('"window" >= 1 and period_s > 0', name=op.f("ck_session_conditions_window")),
        sa.CheckConstraint("min_ma >= 0 and max_ma >= min_ma", name=op.f("ck_session_conditions_limits")),
        sa.CheckConstraint("lead_amplitude_ma >= 0 and cdbs_amplitude_ma > 0", name=op.f("ck_session_conditions_amplitudes")),
        sa.ForeignKeyConstraint(
            ["session_id"], ["session.id"], name=op.f("fk_session_conditions_session_id_session"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_session_conditions")),
        sa.UniqueConstraint("session_id", "revision", name=op.f("uq_session_conditions_session_id_revision")),
    )
    op.create_index(op.f("ix_session_conditions_session_id"), "session_conditions", ["session_id"], unique=False)
    op.add_column("settings_version", sa.Column("pool_programmings", sa.Boolean(), server_default="false", nullable=False))
    op.add_column("snapshot_session", sa.Column("conditions_id", sa.Integer(), nullable=True))
    op.create_foreign_key(
        op.f("fk_snapshot_session_conditions_id_session_conditions"), "snapshot_session", "session_conditions", ["conditions_id"], ["id"]
    )
    for table, key, hidden in AUDITED:
        op.execute(
            f"create trigger audit after insert or update or delete on {table} for each row execute function audit_row('{hidden}', '{key}')"
        )
    _assume(op.get_bind())
    for table in NEVER_CHANGED:
        op.execute(f"create trigger never_changed before update or delete on {table} for each row execute function refuse_change()")


def _assume(connection: sa.Connection) -> None:
    """Conditions of every confirmed session: the settings in force when it began, else when it was taken in, else the first ones."""
    sessions = connection.execute(
        sa.text(
            "select s.id, s.hemisphere, s.policy_id, s.started_at, v.lower_bound, v.window, v.period_s, v.xi_beta,"
            " coalesce(("
            "  select c.amplitude_ma from cdbs_amplitude c where c.visit_id = s.visit_id and c.program = 0"
            "  and (s.hemisphere is null or c.hemisphere = s.hemisphere) order by c.hemisphere limit 1), v.cdbs_amplitude_ma) as cdbs_ma"
            " from session s join visit on visit.id = s.visit_id cross join lateral ("
            "  select w.* from settings_version w where w.participant_id = visit.participant_id"
            "  order by (w.created_at <= s.started_at) is true desc, (w.created_at <= s.created_at) desc,"
            "   case when w.created_at <= s.created_at then w.version else -w.version end desc limit 1) v"
            " where s.status = 'confirmed' order by s.id"
        )
    ).all()
    for s in sessions:
        parts = connection.execute(
            sa.text(
                "select g.recording_id, g.start_s, g.stop_s, g.is_control, r.hemisphere, r.details from session_segment g"
                " join recording r on r.id = g.recording_id where g.session_id = :id order by g.start_s"
            ),
            {"id": s.id},
        ).all()
        programs: dict[str, None] = {}
        lead = None
        for part in parts:
            side = part.hemisphere or (s.hemisphere if part.is_control else None)
            programs |= dict.fromkeys(json.dumps(p, sort_keys=True) for p in _programs(part, side))
            if part.is_control and lead is None:
                lead = _lead_ma(connection, part, s.cdbs_ma)
        low, high = _limits(connection, s)
        connection.execute(
            sa.text(
                'insert into session_conditions (session_id, revision, origin, lower_bound, "window", period_s, xi_beta, min_ma, max_ma,'
                " lead_amplitude_ma, cdbs_amplitude_ma, programming, entered_by, reason) values (:id, 1, 'assumed', :lower_bound,"
                " :window, :period_s, :xi_beta, :low, :high, :lead, :cdbs, cast(:programs as jsonb), 'system', :reason)"
            ),
            {
                "id": s.id,
                "lower_bound": s.lower_bound,
                "window": s.window,
                "period_s": s.period_s,
                "xi_beta": s.xi_beta,
                "low": low,
                "high": high,
                "lead": lead,
                "cdbs": s.cdbs_ma if s.cdbs_ma and s.cdbs_ma > 0 else None,
                "programs": "[" + ", ".join(programs) + "]",
                "reason": "assumed: the settings of the time",
            },
        )


def _programs(part: Any, side: str | None) -> list[dict[str, Any]]:
    """Programs in force in a part of a recording, as `app.study.sessions.programming` reads them."""
    therapy = (part.details.get("settings") or {}).get("therapy")
    if isinstance(therapy, dict):
        known = {name: therapy.get(name) for name in ("contacts", "pulse_width_us", "rate_hz")}
        if not any(known.values()):
            return []
        return [{**known, "hemisphere": side, "group": therapy.get("group"), "program": 0, "contacts": known["contacts"] or ""}]
    states = [e for e in part.details.get("events") or [] if e.get("kind") == "stimulation"]
    before = [e for e in states if float(e["t_s"]) <= part.start_s]
    in_force = [*(before[-1:] or states[:1]), *(e for e in states if part.start_s < float(e["t_s"]) < part.stop_s)]
    return [
        {
            "hemisphere": side,
            "group": data.get("group"),
            "program": int(p["program"]),
            "contacts": p.get("contacts") or "",
            "pulse_width_us": p.get("pulse_width_us"),
            "rate_hz": data.get("rate_hz"),
        }
        for data in (e.get("data") or {} for e in in_force)
        if data.get("therapy_on") is not False
        for p in data.get("programs") or []
    ]


def _lead_ma(connection: sa.Connection, part: Any, cdbs_ma: float | None) -> float | None:
    """The newest known amplitude before a session's part of its control recording, mA."""
    trace = connection.execute(
        sa.text(
            "select dt_s, first_end_s, n, unit, values_f32, valid_bits from trace where recording_id = :id and stream = 'amplitude'"
            " order by decode_version desc, channel limit 1"
        ),
        {"id": part.recording_id},
    ).first()
    if trace is None or (trace.unit != "mA" and not cdbs_ma):
        return None
    ends = trace.first_end_s + trace.dt_s * np.arange(trace.n)
    valid = np.unpackbits(np.frombuffer(trace.valid_bits, dtype=np.uint8), count=trace.n).astype(bool)
    rows = np.flatnonzero(valid & (ends <= part.start_s + trace.dt_s / 2) & (ends > part.start_s - LEAD_ROWS * trace.dt_s))
    if rows.size == 0:
        return None
    value = float(np.frombuffer(trace.values_f32, dtype="<f4")[rows[-1]])
    return value if trace.unit == "mA" else value * float(cdbs_ma or 0.0)


def _limits(connection: sa.Connection, session: Any) -> tuple[float | None, float | None]:
    """Limits of the newest bundle of the session's policy that was released before it."""
    if session.policy_id is None:
        return None, None
    row = connection.execute(
        sa.text(
            "select min_ma, max_ma from bundle_release where policy_id = :policy and (cast(:moment as timestamptz) is null"
            " or created_at <= :moment) order by created_at desc limit 1"
        ),
        {"policy": session.policy_id, "moment": session.started_at},
    ).first()
    return (None, None) if row is None else (row.min_ma, row.max_ma)


def downgrade() -> None:
    """Without conditions, which the audit trail holds too."""
    op.drop_constraint(op.f("fk_snapshot_session_conditions_id_session_conditions"), "snapshot_session", type_="foreignkey")
    op.drop_column("snapshot_session", "conditions_id")
    op.drop_column("settings_version", "pool_programmings")
    op.drop_table("session_conditions")
