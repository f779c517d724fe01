"""A participant's record as a Frictionless data package, with a script that recomputes the primary tables."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

from sqlalchemy.orm import Session

from app import __version__
from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.analysis.figures import csv_of
from app.analysis.primary import Primary, primary
from app.analysis.primary_schemas import csv_rows
from app.analysis.standing import standing_sentences
from app.evaluation import wording
from app.evaluation.estimates.coverage import coverage_by_policy
from app.evaluation.estimates.service import estimate_of
from app.overview import repository
from app.overview.package_dictionary import FIELDS, TITLES, Days, descriptor
from app.platform.audit import record
from app.platform.errors import BetaloopError
from app.study import access, blinding
from app.study import repository as study
from app.study.adverse_events import events_of_participant, policy_of
from app.study.characteristics import CharacteristicsOut
from app.study.doses import hours_since_dose, levodopa_equivalent_mg
from app.study.sessions.contradictions import control_recording
from app.study.sessions.repository import policy_shares
from app.study.sessions.usable_steps import session_data
from app.study.settings_types import SettingsOut
from app.tables.adverse_events import AdverseEvent
from app.tables.learning import Policy
from app.tables.participants import Participant
from app.tables.sessions import Controller
from app.tables.uploads import UploadFile
from app.tables.visits import Drug
from ml.formats.studies.sheet import write_sheet
from ml.formats.tables.log_head import STATED_FIELDS
from ml.outcomes import BY_KEY, OUTCOMES
from ml.outcomes.records import Outcome
from ml.qoc import Margins
from ml.statistics.within_visits.contrasts import Average

# A participant's record as a Frictionless data package: tables, their dictionary, and a script that checks them.


def export_sheet(db: Session, participant: Participant, caller: Caller) -> bytes:
    """Write a participant's confirmed sessions as the sheet that imports them with their files."""
    access.require(caller, can.READ, participant)
    record(db, "export", "participant", participant.id)
    return write_sheet(sheet_of(db, participant, caller)).encode()


def sheet_of(db: Session, participant: Participant, caller: Caller) -> list[dict[str, Any]]:
    """List a participant's confirmed sessions as rows of a sheet that `import_study` reads; without what must stay hidden."""
    out = []
    for session in study.sessions_of_participant(db, participant.id):
        arm = blinding.visible_arm(session, caller)
        if arm is None or not session.segments:
            continue
        control, stated = control_recording(session), session.conditions
        file = db.get(UploadFile, control.upload_file_id) if control.upload_file_id is not None else None
        random = arm.controller == Controller.RANDOM and stated is not None
        out.append(
            {
                "participant": participant.code,
                "visit": session.visit.number,
                "date": session.visit.date,
                "start": session.started_at.isoformat() if session.started_at else None,
                "minutes": round(session.duration_s / 60.0, 4),
                "controller": arm.controller.value,
                "policy": study.policy_name(db, arm.policy_id),
                "hemisphere": session.hemisphere,
                "sha256": file.original_sha256 if file else None,
                "medication_h": session.medication_h,
                **{name: getattr(stated, name) or None for name in STATED_FIELDS if random},
                **{o.field: getattr(session.qoc, o.field, None) for o in OUTCOMES},
            }
        )
    return out


def export_participant(db: Session, participant: Participant, caller: Caller) -> bytes:
    """Export everything the caller may know of a participant, as a zipped data package. Controllers come through the blinding gate.

    Sessions of a blinded plan whose key is sealed are excluded, and README.txt names their visits.

    A session whose steps cannot be read has its row all the same, with the reason in the column `problem`. No date leaves: times are days
    since the participant was enrolled.
    """
    access.require(caller, can.READ, participant)
    record(db, "export", "participant", participant.id)
    found = primary(db, participant, caller)
    day = Days(participant.created_at)
    standings = standing_sentences(db, participant, caller)
    sessions, steps = _sessions(db, participant, caller, found, day)
    tables = {
        "sessions": sessions,
        "steps": steps,
        "visits": [(v.number, day.of_date(v.date), v.locked, len(v.sessions)) for v in participant.visits],
        "policies": [(*_policy_row(p, day), standings.get(p.id)) for p in repository.policies(db, participant.id)],
        "estimates": _estimate_rows(db, participant),
        "coverage": _coverage_rows(db, participant),
        "margins": _margin_rows(participant, day),
        "adverse_events": [_event_row(e, caller, day) for e in events_of_participant(db, participant.id)],
        "doses": _dose_rows(participant, day),
        "primary": [row[1:] for row in csv_rows(found)],
        "noninferiority": _noninferiority_rows(found, day),
        "outcomes": _outcome_rows(),
    }
    settings = [SettingsOut.model_validate(s).model_dump(mode="json", exclude={"created_at"}) for s in participant.settings]
    contents = {
        f"{name}.csv": csv_of([f.name for f in FIELDS[name]], ([_cell(c) for c in row] for row in rows)) for name, rows in tables.items()
    }
    stated = [
        CharacteristicsOut.model_validate(c).model_dump(mode="json", exclude={"created_at", "created_by"})
        for c in participant.characteristics
    ]
    contents |= {
        "characteristics.json": json.dumps(stated, indent=2),
        "datapackage.json": json.dumps(descriptor(participant.code, participant.synthetic, contents), indent=2, ensure_ascii=False),
        "settings.json": json.dumps(settings, indent=2),
        "recompute.py": Path(__file__).with_name("recompute.py").read_text("utf-8"),
        "README.txt": _readme(participant, caller),
    }
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in contents.items():
            archive.writestr(zipfile.ZipInfo(f"{participant.code}/{name}"), text)
    return sink.getvalue()


def _sessions(
    db: Session, participant: Participant, caller: Caller, found: Primary, day: Days
) -> tuple[list[tuple[Any, ...]], list[tuple[Any, ...]]]:
    compared = {s.session_id for s in found.sessions if "mean_beta" in s.values}
    held = blinding.unsealed(study.sessions_of_participant(db, participant.id))
    shares = policy_shares(db, [s.id for s in held])
    sessions: list[tuple[Any, ...]] = []
    steps: list[tuple[Any, ...]] = []
    for session in held:
        arm, qoc = blinding.arm(session, caller), session.qoc
        try:
            table, problem = session_data(db, session).table, None
        except BetaloopError as error:
            table, problem = None, str(error)
        beta = table and table.beta_trace
        sessions.append(
            (session.id, session.visit.number, session.ordinal, arm.controller.value, arm.policy_id, session.hemisphere,
             day.of(session.started_at), day.of(session.created_at), session.duration_s, beta and beta.unit, beta and beta.source,
             session.id in compared, table and table.cdbs_ma, table and table.above_one, session.excluded_reason, session.stopped_reason,
             shares.get(session.id), hours_since_dose(session), session.activity,
             *(qoc and qoc.value(o) for o in OUTCOMES), qoc and qoc.revision, problem)
        )  # fmt: skip
        if table is not None:
            rows = zip(table.t_s, table.beta, table.amplitude_ma, table.fraction, strict=True)
            steps.extend((session.id, *(None if v != v else float(v) for v in row)) for row in rows)
    return sessions, steps


def _margin_rows(participant: Participant, day: Days) -> list[tuple[Any, ...]]:
    locked = {lock.margins_version_id: lock.created_at for lock in participant.margins_locks}
    return [
        (m.version, *(getattr(m, o.margin.field) for o in OUTCOMES), day.of(m.created_at), day.of(locked.get(m.id)))
        for m in participant.margins
    ]


def _outcome_rows() -> list[tuple[Any, ...]]:
    return [(o.key, o.column, o.unit, o.higher_is_better, o.resolution, o.bounded, o.scale == "ordinal", o.failure) for o in OUTCOMES]


def _share(outcome: Outcome, margins: Margins) -> float | None:
    """Return the margin of an outcome as a share of the value under cDBS; None where it is none."""
    return margins.of(outcome) if outcome.margin.kind == "share" else None


def _event_row(event: AdverseEvent, caller: Caller, day: Days) -> tuple[Any, ...]:
    now, visit = event.now, event.visit
    known = now.kind, now.severity, now.serious, day.of(event.occurred_at), day.of(now.ended_at), now.relation, now.action, now.outcome
    number = visit.number if visit is not None else None
    return (event.id, now.revision, number, event.session_id, policy_of(event, caller), *known, now.cleared_reason is not None)


def _dose_rows(participant: Participant, day: Days) -> list[tuple[Any, ...]]:
    return [
        (v.number, d.drug, d.mg, levodopa_equivalent_mg(Drug(d.drug), d.mg), day.of(d.taken_at))
        for v in participant.visits
        for d in v.doses
    ]


def _noninferiority_rows(found: Primary, day: Days) -> list[tuple[Any, ...]]:
    rows = []
    for v in (*found.earlier, *found.verdicts):
        lock, drawn = v.locked, " ".join(map(str, v.drawn_from))
        under = lock.version, day.of(lock.locked_at), day.of(lock.until)
        for o in v.assessment.outcomes if v.assessment else ():
            estimate = o.average.estimate if isinstance(o.average, Average) else None
            judged = o.name, o.margin, _share(BY_KEY[o.name], lock.margins), estimate, o.p_non_inferior, o.failures
            rows.append((v.controller.value, v.confirmatory, *under, *judged, drawn))
    return rows


def _policy_row(p: Policy, day: Days) -> tuple[Any, ...]:
    return (p.id, p.name, p.kind, p.algorithm, p.teacher_id, p.snapshot_id, p.seed, day.of(p.created_at), p.onnx_sha256)


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


def _cell(value: Any) -> Any:
    """Convert a cell for Frictionless: truth in small letters."""
    return str(value).lower() if isinstance(value, bool) else value


def _readme(participant: Participant, caller: Caller) -> str:
    sealed = [str(v.number) for v in participant.visits if v.sealed and not caller.is_system]
    left_out = f"\nLeft out: the sessions of visit {', '.join(sealed)}, whose blinded plan's key is sealed.\n" if sealed else ""
    listed = "\n".join(f"{name + '.csv':22}{text}" for name, text in TITLES.items())
    return (
        f"betaloop {__version__}: record of participant {participant.code}, as a Frictionless data package.\n\n"
        f"{'The participant is synthetic: a simulation and no person.' + chr(10) * 2 if participant.synthetic else ''}"
        "datapackage.json      the dictionary: every column of every table with its type, unit and meaning\n"
        f"{listed}\n"
        "settings.json         every settings version\n"
        "characteristics.json  leads, symptoms, hand and medication schedule, every version\n"
        "recompute.py          recomputes the primary tables from sessions and steps with numpy and scipy, and compares\n\n"
        "Days are counted from the enrolment in the software; what happened before has a day below 0.\n"
        f"{left_out}"
    )
