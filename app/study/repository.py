"""Every query of the study's tables, and the row scope: what a caller may not read does not exist for it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date, datetime
from typing import Any, NamedTuple

from sqlalchemy import ARRAY, ColumnElement, Integer, Select, any_, cast, false, func, or_, select, true
from sqlalchemy.orm import Session, contains_eager, joinedload, lazyload, selectinload
from sqlalchemy.orm.interfaces import LoaderOption

from app.accounts.permissions import READ_ARMS, Caller
from app.platform.errors import NotFound
from app.tables.accounts import Site, Study
from app.tables.audit import AuditEvent
from app.tables.learning import Policy
from app.tables.outcomes import QocRevision
from app.tables.participants import Participant, SettingsVersion
from app.tables.plans import BundleRelease, Plan, PlanItem
from app.tables.recordings import Recording, Trace
from app.tables.sessions import SessionSegment, StudySession
from app.tables.uploads import UploadFile
from app.tables.visits import Visit, VisitLock

CONFIRMED = StudySession.status == "confirmed"
"""Condition on `StudySession`: only what a person has confirmed counts in buffers, analyses, rankings and exports."""
_WHOLE = (
    joinedload(Participant.site),
    selectinload(Participant.settings),
    selectinload(Participant.margins),
    selectinload(Participant.margins_locks),
)
"""What every page of a participant asks for."""
_OF_ONE_VISIT = (joinedload(Visit.cdbs_amplitudes), joinedload(Visit.doses), joinedload(Visit.locks))  # few, in the visit's own query


def in_scope(caller: Caller) -> ColumnElement[bool]:
    """Build the condition on `Site`: the sites that some grant of the caller covers."""
    if caller.is_system:
        return true()
    conditions = [(Site.study_id == g.study_id) & (Site.id == g.site_id if g.site_id else true()) for g in caller.grants]
    return or_(*conditions) if conditions else false()


def participant_by_code(db: Session, code: str, caller: Caller) -> Participant:
    """Load the participant of a code. Raises NotFound."""
    query = select(Participant).join(Participant.site).where(Participant.code == code, in_scope(caller))
    few = joinedload(Participant.site), joinedload(Participant.margins), joinedload(Participant.margins_locks)
    if (row := db.scalars(query.options(*few, selectinload(Participant.settings))).unique().one_or_none()) is None:
        raise NotFound(f"There is no participant '{code}', or you have no access to it.")
    return row


def sites(db: Session, caller: Caller) -> Sequence[Site]:
    """List sites that the caller may see, by code."""
    return db.scalars(select(Site).where(in_scope(caller)).order_by(Site.code)).all()


def hold_participation(db: Session, participant: Participant) -> None:
    """Read again whether the participant takes part and the study goes on, and block the end of either until this transaction ends."""
    db.refresh(participant.site.study, ["ended_at"], with_for_update={"read": True, "of": Study})
    db.refresh(participant, ["status"], with_for_update={"of": Participant})


def participants_of_study(db: Session, study_id: int) -> Sequence[int]:
    """List the numbers of a study's participants."""
    return db.scalars(select(Participant.id).join(Participant.site).where(Site.study_id == study_id).order_by(Participant.id)).all()


def participants(db: Session, caller: Caller, limit: int | None, offset: int, withdrawn: bool = True) -> tuple[Sequence[Participant], int]:
    """Load a page of participants by code, and count them all; those withdrawn or of an ended study only with `withdrawn`.

    Args:
        limit: None for all from `offset` on.
    """
    query = _participants(caller, withdrawn)
    rows = db.scalars(query.order_by(Participant.code).limit(limit).offset(offset).options(*_WHOLE)).all()
    return rows, count(db, query)


def next_visits(db: Session, caller: Caller, today: date, withdrawn: bool = True) -> Sequence[Participant]:
    """List every participant with a visit dated today or later: whose first such visit is soonest, first, then by code."""
    first = select(Visit.participant_id, func.min(Visit.date).label("day")).where(Visit.date >= today)
    days = first.group_by(Visit.participant_id).subquery()
    query = _participants(caller, withdrawn).join(days, days.c.participant_id == Participant.id)
    return db.scalars(query.order_by(days.c.day, Participant.code).options(*_WHOLE)).all()


def _participants(caller: Caller, withdrawn: bool) -> Select[Participant]:
    query = select(Participant).join(Participant.site).where(in_scope(caller))
    if withdrawn:
        return query
    return query.join(Site.study).where(Participant.status != "withdrawn", Study.ended_at.is_(None))


def visits(db: Session, participant_id: int, limit: int, offset: int) -> tuple[Sequence[Visit], int]:
    """Load a page of a participant's visits by number."""
    query = select(Visit).where(Visit.participant_id == participant_id)
    rows = db.scalars(query.order_by(Visit.number).limit(limit).offset(offset).options(selectinload(Visit.cdbs_amplitudes))).all()
    return rows, count(db, query)


def visit(db: Session, visit_id: int, caller: Caller) -> Visit:
    """Load a visit. Raises NotFound."""
    query = select(Visit).join(Visit.participant).join(Participant.site).where(Visit.id == visit_id, in_scope(caller))
    of_participant = joinedload(Visit.participant).joinedload(Participant.site)
    if (row := db.scalars(query.options(of_participant, *_OF_ONE_VISIT)).unique().one_or_none()) is None:
        raise NotFound(f"There is no visit {visit_id}, or you have no access to it.")
    return row


def visit_by_number(db: Session, participant_id: int, number: int) -> Visit | None:
    """Find a participant's visit by its number."""
    query = select(Visit).where(Visit.participant_id == participant_id, Visit.number == number)
    return db.scalars(query.options(*_OF_ONE_VISIT)).unique().one_or_none()


class HiddenVisits(NamedTuple):
    """Visits that hide what ran from a caller, by participant: (visit, key is sealed, locked)."""

    rows: Mapping[int, Sequence[tuple[int, bool, bool]]]

    def sealed(self, participant_id: int) -> frozenset[int]:
        """Return a participant's visits under a blinded plan whose key is sealed."""
        return frozenset(visit for visit, sealed, _ in self.rows.get(participant_id, ()) if sealed)

    def unlocked(self, participant_id: int) -> frozenset[int]:
        """Return a participant's visits that are not locked now."""
        return frozenset(visit for visit, _, locked in self.rows.get(participant_id, ()) if not locked)


def hidden_visits(db: Session, participant_ids: Collection[int]) -> HiddenVisits:
    """Load the visits of participants, each with whether its key is sealed and whether it is locked."""
    newest = select(VisitLock.locked).where(VisitLock.visit_id == Visit.id).order_by(VisitLock.id.desc()).limit(1)
    locked = func.coalesce(newest.correlate(Visit).scalar_subquery(), false())
    query = select(Visit.participant_id, Visit.id, Visit.sealed, locked).where(Visit.participant_id.in_(participant_ids))
    found: dict[int, list[tuple[int, bool, bool]]] = {}
    for owner, visit, sealed, is_locked in db.execute(query):
        found.setdefault(owner, []).append((visit, sealed, is_locked))
    return HiddenVisits(found)


def tells_some_arm(db: Session, caller: Caller, code: str | None) -> bool:
    """Check whether a blinded assessor may know what ran at some visit: of the participant with a code, else of all that they may read.

    At sites where another role shows arms at once, every visit whose key is not sealed counts.
    """
    told = [(Site.study_id == g.study_id) & (Site.id == g.site_id if g.site_id else true()) for g in caller.grants_with(READ_ARMS)]
    newest = select(VisitLock.locked).where(VisitLock.visit_id == Visit.id).order_by(VisitLock.id.desc()).limit(1)
    locked = func.coalesce(newest.correlate(Visit).scalar_subquery(), false())
    query = select(Visit.id).join(Visit.participant).join(Participant.site).where(in_scope(caller), ~Visit.sealed, or_(locked, *told))
    return db.scalar((query if code is None else query.where(Participant.code == code)).limit(1)) is not None


def lock_row(db: Session, visit: Visit) -> None:
    """Lock a visit's row for this transaction and read its locks again, so that two people at once are checked in turn."""
    db.execute(select(Visit.id).where(Visit.id == visit.id).with_for_update())
    db.expire(visit, ["locks"])


def session(db: Session, session_id: int, caller: Caller) -> StudySession:
    """Load a session with its QoCs, segments and visit. Raises NotFound."""
    query = _sessions(*_OF_ONE_VISIT).join(Participant.site).where(StudySession.id == session_id, in_scope(caller))
    if (row := db.scalars(query).unique().one_or_none()) is None:
        raise NotFound(f"There is no session {session_id}, or you have no access to it.")
    return row


def sessions_of_visit(db: Session, visit_id: int, limit: int = 500, offset: int = 0) -> tuple[Sequence[StudySession], int]:
    """Load a page of a visit's confirmed sessions in order."""
    mine = (StudySession.visit_id == visit_id) & CONFIRMED
    rows = db.scalars(_sessions().where(mine).order_by(StudySession.ordinal).limit(limit).offset(offset)).all()
    return rows, count(db, select(StudySession.id).where(mine))


def sessions_of_participant(db: Session, participant_id: int, with_proposals: bool = False, afresh: bool = False) -> Sequence[StudySession]:
    """Load confirmed sessions of a participant by visit and order, with QoCs, segments and recordings; proposals only on request.

    `afresh`: what this transaction has read of them before is read again, for what is kept under the rows' present versions.
    """
    query = _sessions().where(Visit.participant_id == participant_id, true() if with_proposals else CONFIRMED)
    query = query.execution_options(populate_existing=afresh)
    return db.scalars(query.order_by(Visit.number, StudySession.ordinal)).all()


def sessions_without_data(db: Session, participant_ids: Collection[int]) -> Sequence[StudySession]:
    """Load confirmed sessions of several participants with their visits, and nothing else of them: for counts and arms."""
    query = select(StudySession).join(StudySession.visit).where(Visit.participant_id.in_(participant_ids), CONFIRMED)
    visit = contains_eager(StudySession.visit).options(lazyload(Visit.cdbs_amplitudes), lazyload(Visit.doses))
    return db.scalars(query.options(visit).order_by(Visit.participant_id, Visit.number)).all()


def sessions_for_lists(db: Session, participant_id: int) -> Sequence[StudySession]:
    """Load confirmed sessions of a participant by visit and order, with their visits and QoCs, and nothing of their recordings."""
    query = select(StudySession).join(StudySession.visit).where(Visit.participant_id == participant_id, CONFIRMED)
    query = query.options(contains_eager(StudySession.visit), selectinload(StudySession.qocs))
    return db.scalars(query.order_by(Visit.number, StudySession.ordinal)).all()


def proposals_of_participant(db: Session, participant_id: int) -> Sequence[StudySession]:
    """Load sessions that wait for a person's confirmation, by visit and start."""
    query = _sessions().where(Visit.participant_id == participant_id, StudySession.status == "proposed")
    return db.scalars(query.order_by(Visit.number, StudySession.started_at, StudySession.id)).all()


def next_ordinal(db: Session, visit_id: int) -> int:
    """Return the next free place in a visit."""
    return (db.scalar(select(func.max(StudySession.ordinal)).where(StudySession.visit_id == visit_id)) or 0) + 1


@contextmanager
def traces_read_once(db: Session) -> Iterator[None]:
    """Read the traces of each recording once within the block, which may change traces but neither adds nor removes any."""
    db.info[_TRACES] = {}
    try:
        yield
    finally:
        del db.info[_TRACES]


_TRACES = "traces by recording"
_READING = Trace.decode_version * 1_000_000 + Trace.reading
"""Order of the readings of a recording: by version, then by number."""


def traces_of_recording(db: Session, recording_id: int) -> Sequence[Trace]:
    """Load the traces of a recording in its newest decode version."""
    known: dict[int, Sequence[Trace]] = db.info.get(_TRACES, {})
    if recording_id not in known:
        newest = select(func.max(_READING)).where(Trace.recording_id == recording_id).scalar_subquery()
        query = select(Trace).where(Trace.recording_id == recording_id, newest == _READING)
        known[recording_id] = db.scalars(query.order_by(Trace.stream, Trace.channel)).all()
    return known[recording_id]


def traces_of_recordings(db: Session, recording_ids: Collection[int]) -> dict[int, list[Trace]]:
    """Load the traces of many recordings at once, by recording; read only, and not the session's own rows."""
    columns = [c for c in Trace.__table__.columns if c.name != "details"]
    wanted = any_(cast(list(recording_ids), ARRAY(Integer)))  # one parameter, where `in` has one for each
    query = select(*columns).where(Trace.recording_id == wanted).order_by(Trace.stream, Trace.channel)
    found: dict[int, list[Any]] = {}
    for row in db.execute(query):
        found.setdefault(row.recording_id, []).append(row)
    return _newest_reading(found)


def _newest_reading(traces_of: Mapping[int, list[Any]]) -> dict[int, list[Any]]:
    """Keep the traces of each recording's newest reading."""
    newest = {i: max((t.decode_version, t.reading) for t in traces) for i, traces in traces_of.items()}
    return {i: [t for t in traces if (t.decode_version, t.reading) == newest[i]] for i, traces in traces_of.items()}


@dataclass(frozen=True)
class TraceHead:
    """A trace without its values."""

    id: int
    recording_id: int
    stream: str
    channel: str
    decode_version: int
    reading: int


def trace_heads(db: Session, recording_ids: Collection[int]) -> dict[int, list[TraceHead]]:
    """Load the heads of traces by recording, in their newest reading and in the order of `traces_of_recording`."""
    columns = (Trace.id, Trace.recording_id, Trace.stream, Trace.channel, Trace.decode_version, Trace.reading)
    wanted = any_(cast(list(recording_ids), ARRAY(Integer)))  # one parameter, where `in` has one for each
    query = select(*columns).where(Trace.recording_id == wanted).order_by(Trace.stream, Trace.channel)
    found: dict[int, list[TraceHead]] = {}
    for row in db.execute(query):
        found.setdefault(row.recording_id, []).append(TraceHead(*row))
    return _newest_reading(found)


def recording_by_fingerprint(db: Session, participant_id: int, fingerprint: str) -> Recording | None:
    """Find a participant's recording by its fingerprint."""
    return db.scalar(select(Recording).where(Recording.participant_id == participant_id, Recording.fingerprint == fingerprint))


def session_ids_of_recording(db: Session, recording_id: int) -> Sequence[int]:
    """List sessions that a recording belongs to."""
    return db.scalars(select(SessionSegment.session_id).where(SessionSegment.recording_id == recording_id).distinct()).all()


def qoc_revision(db: Session, session_id: int) -> int:
    """Count the revisions of a session's QoCs."""
    return db.scalar(select(func.count()).select_from(QocRevision).where(QocRevision.session_id == session_id)) or 0


def last_editor(db: Session, entity: str, row_id: int) -> str:
    """Return who changed a session or a visit (with its amplitudes) last, by the audit trail; empty where there was no change."""
    mine = (AuditEvent.entity == entity) & (AuditEvent.entity_id == str(row_id))
    if entity == "visit":
        row = func.coalesce(AuditEvent.after, AuditEvent.before)
        mine |= (AuditEvent.entity == "cdbs_amplitude") & (row["visit_id"].as_integer() == row_id)
    return db.scalar(select(AuditEvent.actor).where(mine).order_by(AuditEvent.id.desc()).limit(1)) or ""


def lock_session(db: Session, session: StudySession) -> None:
    """Lock a session and read its QoCs again, so that two corrections at once become two revisions and neither is lost."""
    db.execute(select(StudySession.id).where(StudySession.id == session.id).with_for_update())
    db.expire(session, ["qocs", "conditions_revisions"])


def uploads_of_files(db: Session, upload_file_ids: Sequence[int]) -> dict[int, int]:
    """Find the number of the upload that each file came in."""
    if not upload_file_ids:
        return {}
    rows = db.execute(select(UploadFile.id, UploadFile.upload_id).where(UploadFile.id.in_(upload_file_ids)))
    return {row.id: row.upload_id for row in rows}


def policy_id(db: Session, participant_id: int, name_or_id: str) -> int | None:
    """Find the number of a participant's policy by name, or by number where no policy has that name."""
    own = select(Policy.id).where(Policy.participant_id == participant_id)
    found = db.scalar(own.where(Policy.name == name_or_id))
    if found is None and name_or_id.isdecimal() and len(name_or_id) < 10:
        found = db.scalar(own.where(Policy.id == int(name_or_id)))
    return found


def policy_names(db: Session, participant_id: int) -> Sequence[str]:
    """List the names of a participant's policies."""
    return db.scalars(select(Policy.name).where(Policy.participant_id == participant_id).order_by(Policy.name)).all()


def policy_name(db: Session, policy_id: int | None) -> str | None:
    """Return the name of a policy, by its number."""
    return None if policy_id is None else db.scalar(select(Policy.name).where(Policy.id == policy_id))


def has_policy(db: Session, participant_id: int, policy_id: int) -> bool:
    """Return True for a policy of the participant."""
    return db.scalar(select(Policy.id).where(Policy.id == policy_id, Policy.participant_id == participant_id)) is not None


class PolicyHead(NamedTuple):
    """Facts of a policy that sessions need."""

    id: int
    name: str
    kind: str


def policies_of_network(db: Session, participant_id: int, sha256: str) -> Sequence[PolicyHead]:
    """List the participant's policies whose network file has this SHA-256, the newest first."""
    query = select(Policy.id, Policy.name, Policy.kind).where(Policy.participant_id == participant_id, Policy.onnx_sha256 == sha256)
    return [PolicyHead(*row) for row in db.execute(query.order_by(Policy.id.desc()))]


def released_limits(db: Session, policy_id: int, moment: datetime | None) -> tuple[float, float] | None:
    """Find the amplitude limits, mA, of the newest bundle of a policy that was released before a moment; None where there is none."""
    query = select(BundleRelease.min_ma, BundleRelease.max_ma).where(BundleRelease.policy_id == policy_id)
    if moment is not None:
        query = query.where(BundleRelease.created_at <= moment)
    row = db.execute(query.order_by(BundleRelease.created_at.desc()).limit(1)).first()
    return None if row is None else (float(row.min_ma), float(row.max_ma))


def planned_designs(db: Session, visit_id: int) -> list[dict[str, Any]]:
    """List the designs of the random sessions in a visit's approved plan, by position; those that are drawn by the device have none."""
    query = select(PlanItem.design).join(Plan, Plan.id == PlanItem.plan_id)
    query = query.where(Plan.visit_id == visit_id, Plan.status == "approved", PlanItem.design.is_not(None))
    return [row for row in db.scalars(query.order_by(PlanItem.position)) if row is not None and row["holds"]]


def settings_version(db: Session, settings_version_id: int) -> SettingsVersion:
    """Load a settings version by its row number."""
    return db.get_one(SettingsVersion, settings_version_id)


def count(db: Session, query: Select[Any]) -> int:
    """Count the rows of a query without its page."""
    return db.scalar(select(func.count()).select_from(query.order_by(None).subquery())) or 0


def _sessions(*of_visits: LoaderOption) -> Select[StudySession]:
    return (
        select(StudySession)
        .join(StudySession.visit)
        .join(Visit.participant)
        .options(
            contains_eager(StudySession.visit).contains_eager(Visit.participant).joinedload(Participant.site),
            contains_eager(StudySession.visit).options(*of_visits or [selectinload(Visit.cdbs_amplitudes)]),
            selectinload(StudySession.qocs),
            selectinload(StudySession.conditions_revisions),
            selectinload(StudySession.segments).joinedload(SessionSegment.recording),
        )
    )
