"""Outcomes on their way from a decoded file to the QoCs of sessions: minutes of tremor by the clock, grasp tests by a stated session."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy.orm import Session

from app.platform.errors import Invalid
from app.study import repository as study
from app.study.outcomes import service as outcomes
from app.study.outcomes import values as of_files
from app.tables.sessions import StudySession
from app.tables.uploads import UploadFile
from ml.formats import GraspLog, OutcomeLog, TremorLog

NO_SESSION = (
    "A grasp file names no clock, so that nobody can tell its session from it: it is kept. Attach it on the page of proposals, "
    "or upload it again and name the session."
)


def take_clocked(db: Session, file: UploadFile, logs: Sequence[OutcomeLog]) -> list[str]:
    """Keep measurements that find their sessions by the clock; sentences for the report, on the sessions that got a value too."""
    said: list[str] = []
    for log in logs:
        if isinstance(log, TremorLog):
            said += outcomes.store_tremor(
                db, file.participant_id, file.id, log.start_unix_s, log.duration_s, log.fractions, log.any_tremor
            )  # fmt: skip
    return said


def take_of_session(db: Session, file: UploadFile, logs: Sequence[OutcomeLog], session: StudySession | None) -> list[str]:
    """Attach a file's measurements without a clock to a session; without one the file waits, and the report says how to attach it.

    Raises:
        Invalid: the session is another participant's.
    """
    tests = [log for log in logs if isinstance(log, GraspLog)]
    if not tests:
        return []
    if session is None:
        return [NO_SESSION]
    if session.visit.participant_id != file.participant_id:
        raise Invalid(f"Session {session.id} belongs to another participant.", "Choose one of this participant's sessions.")
    file.session_id = session.id
    said: list[str] = []
    for log in tests:
        said += outcomes.store_grasp(db, session, file.id, log.hand, log.open_fist_s, log.implausible)
    db.flush()
    return said


def derive(db: Session, session: StudySession) -> list[str]:
    """Derive a session's QoCs again, after it was confirmed or its times changed."""
    return outcomes.derive_for_session(db, session)


def give_up(db: Session, session: StudySession) -> None:
    """Remove the grasp tests of a proposal before it is deleted: they stay as removed rows."""
    outcomes.give_up(db, session)


def stored_of(db: Session, file: UploadFile) -> list[tuple[object, ...]]:
    """Collect all that reading an outcome file again can change: its minutes, its grasp tests, and the QoCs of the participant's
    sessions."""
    series = of_files.tremor_series_of_file(db, file.participant_id, file.id)
    minutes = (series.n, series.start_unix_s_f64, series.duration_s_f64, series.fractions_f32, series.any_tremor_f32) if series else ()
    tests = [(t.session_id, t.hand, t.open_fist_s_f64, tuple(t.implausible)) for t in of_files.grasp_tests_of_file(db, file.id)]
    revisions = [(s.id, len(s.qocs)) for s in study.sessions_of_participant(db, file.participant_id)]
    return [minutes, *tests, *revisions]
