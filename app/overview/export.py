"""A participant's record as a zip of plain tables, for statisticians: every number with its unit in the column's name."""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy.orm import Session

from app import __version__
from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation import wording
from app.evaluation.estimates.coverage import coverage_by_policy
from app.evaluation.estimates.rows import estimate_of
from app.learning.models import Policy
from app.overview import repository
from app.platform.errors import BetaloopError
from app.study import blinding, service
from app.study import repository as study
from app.study.margins.schemas import MarginsOut
from app.study.models import Participant
from app.study.schemas import SettingsOut
from app.study.sessions.data import session_data

_SESSION_COLUMNS = (
    "session_id", "visit", "date", "ordinal", "controller", "policy_id", "hemisphere", "started_at_utc", "duration_s", "beta_unit",
    "beta_source", "cdbs_amplitude_ma", "steps_above_cdbs", "excluded_reason", "grasp_hz", "rating_1_10", "tremor_percent", "qoc_revision",
    "problem",
)  # fmt: skip
_STEP_COLUMNS = ("session_id", "t_s", "beta", "amplitude_ma", "amplitude_fraction")
_POLICY_COLUMNS = ("policy_id", "name", "kind", "algorithm", "teacher_id", "snapshot_id", "seed", "created_at_utc", "onnx_sha256")
_ESTIMATE_COLUMNS = (
    "evaluation_id", "snapshot_id", "settings_version_id", "horizon_steps", "gamma", "policy_id", "method", "value", "low", "high", "level",
    "supported", "flags",
)  # fmt: skip
_COVERAGE_COLUMNS = ("evaluation_id", "policy_id", "supported", "check", "value", "limit", "limit_is", "verdict")


def export_participant(db: Session, participant: Participant, caller: Caller) -> bytes:
    """Everything the caller may know of a participant. The controller of a session comes through the blinding gate.

    A session whose steps cannot be read has its row all the same, with the reason in the column `problem`.
    """
    service.require(caller, can.READ, participant)
    sessions: list[tuple[Any, ...]] = []
    steps: list[tuple[Any, ...]] = []
    for session in study.sessions_of_participant(db, participant.id):
        arm, qoc = blinding.arm(session, caller), session.qoc
        try:
            table, problem = session_data(db, session).table, None
        except BetaloopError as error:
            table, problem = None, str(error)
        beta = table and table.beta_trace
        sessions.append(
            (session.id, session.visit.number, session.visit.date, session.ordinal, arm.controller, arm.policy_id, session.hemisphere,
             session.started_at, session.duration_s, beta and beta.unit, beta and beta.source, table and table.cdbs_ma,
             table and table.above_one, session.excluded_reason, qoc and qoc.grasp_hz, qoc and qoc.rating,
             qoc and qoc.tremor_percent, qoc and qoc.revision, problem)
        )  # fmt: skip
        if table is not None:
            rows = zip(table.t_s, table.beta, table.amplitude_ma, table.fraction, strict=True)
            steps.extend((session.id, *(_blank_nan(v) for v in row)) for row in rows)
    policies = repository.policies(db, participant.id)
    settings = [SettingsOut.model_validate(s).model_dump(mode="json") for s in participant.settings]
    contents = {
        "README.txt": _readme(participant),
        "settings.json": json.dumps(settings, indent=2),
        "margins.json": json.dumps([MarginsOut.model_validate(m).model_dump(mode="json") for m in participant.margins], indent=2),
        "sessions.csv": _csv(_SESSION_COLUMNS, sessions),
        "steps.csv": _csv(_STEP_COLUMNS, steps),
        "policies.csv": _csv(_POLICY_COLUMNS, [_policy_row(p) for p in policies]),
        "estimates.csv": _csv(_ESTIMATE_COLUMNS, _estimate_rows(db, participant)),
        "coverage.csv": _csv(_COVERAGE_COLUMNS, _coverage_rows(db, participant)),
    }
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in contents.items():
            archive.writestr(zipfile.ZipInfo(f"{participant.code}/{name}"), text)
    return sink.getvalue()


def _policy_row(p: Policy) -> tuple[Any, ...]:
    return (p.id, p.name, p.kind, p.algorithm, p.teacher_id, p.snapshot_id, p.seed, p.created_at, p.onnx_sha256)


def _estimate_rows(db: Session, participant: Participant) -> list[tuple[Any, ...]]:
    return [
        (e.id, e.snapshot_id, e.settings_version_id, e.horizon_steps, e.gamma, r.policy_id, r.method, r.value, r.low, r.high, r.level,
         r.supported, wording.joined(estimate_of(r).flags))
        for e, r in repository.estimates(db, participant.id)
    ]  # fmt: skip


def _coverage_rows(db: Session, participant: Participant) -> list[tuple[Any, ...]]:
    return [
        (e.id, policy_id, found.supported, c.name, c.value, c.limit, "least" if c.at_least else "greatest", c.verdict)
        for e in repository.evaluations(db, participant.id)
        for policy_id, found in sorted(coverage_by_policy(e).items())
        for c in found.checks
    ]


def _blank_nan(value: float) -> float | str:
    return "" if value != value else float(value)


def _csv(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(v) for v in row] for row in rows)
    return out.getvalue()


def _cell(value: Any) -> Any:
    """A cell; text that a spreadsheet would run as a formula is quoted with an apostrophe."""
    if isinstance(value, str) and value[:1] in "=+-@\t\r" and value:
        return f"'{value}"
    return "" if value is None else value


def _readme(participant: Participant) -> str:
    return (
        f"betaloop {__version__}: record of participant {participant.code}.\n\n"
        "sessions.csv   one row per session; QoCs in their newest revision; problem: why a session has no steps here\n"
        "steps.csv      2 s rows: t_s is the end of the window after the session's start (t_s <= 0: before it); empty cells are invalid\n"
        "policies.csv   every policy of the participant\n"
        "estimates.csv  every estimate: E[r_end + sum over t < H of gamma^t r_t] with its interval\n"
        "coverage.csv   what the data can say about each policy, checked before it was estimated\n"
        "settings.json  every settings version\n"
        "margins.json   every version of the margins against cDBS and of the levels of verdicts\n"
    )
