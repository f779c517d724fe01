"""QoCs from uploaded files: tremor from a watch's minutes, grasp frequency from hand tracking. Source: Gao et al. 2023, section 3.

A derived value is a revision of the QoCs like any other, and says where it came from. What a person typed is never overwritten; where it
disagrees with the files, `disagreements` has both numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.platform.database import now, set_reason
from app.platform.errors import Invalid
from app.platform.numbers import counted, stated
from app.study import repository
from app.study.adverse_events import stops_of_session
from app.study.outcomes import tremor
from app.study.outcomes import values as of_files
from app.study.outcomes.tremor import Minutes
from app.study.outcomes.values import Derived
from app.tables.adverse_events import AdverseEvent, AdverseEventRevision, EventKind, Severity
from app.tables.outcomes import GraspTest, QocRevision, TremorSeries
from app.tables.participants import Hemisphere
from app.tables.sessions import StudySession
from ml.outcomes import FIELDS
from ml.qoc import TREMOR_CLASSES


@dataclass(frozen=True)
class Disagreement:
    """A QoC that a person typed (or took back) and that differs from the files.

    Attributes:
        name: of the QoC. typed: the person's value, None where it was taken back. author: who entered it.
    """

    name: str
    typed: float | None
    author: str
    derived: Derived


def store_tremor(
    db: Session,
    participant_id: int,
    upload_file_id: int,
    start_unix_s: NDArray[np.float64],
    duration_s: NDArray[np.float64],
    fractions: NDArray[np.float64],
    any_tremor: NDArray[np.float64],
) -> list[str]:
    """Keep all minutes of tremor of a file, and derive the tremor of every confirmed session that they overlap.

    The same file again replaces its own minutes, so that decoding again changes nothing but what the decoder reads otherwise. What was
    replaced stays as a removed row.

    Args:
        db: the caller commits.
        participant_id, upload_file_id: whose minutes, and the file they came in.
        start_unix_s, duration_s: begin and length of each minute, s, shape [n].
        fractions: share per class in the order of `ml.qoc.TREMOR_CLASSES`, shape [n, 6]; NaN where not known.
        any_tremor: share with slight or worse tremor, shape [n]; NaN where not known.

    Returns:
        Sentences for the upload's report.

    Raises:
        ValueError: shapes that do not agree, a minute without time or length.
    """
    minutes = _in_order(start_unix_s, duration_s, fractions, any_tremor)
    before = of_files.tremor_series_of_file(db, participant_id, upload_file_id)
    spans = [(before.first_start_at, before.last_end_at)] if before else []
    if minutes.start_unix_s.size == 0:
        if before is not None:
            before.removed_at = now()
            db.flush()
        return ["The file holds no minute of tremor.", *(_derive_overlapping(db, participant_id, spans) if spans else [])]
    row = TremorSeries(participant_id=participant_id, upload_file_id=upload_file_id)
    tremor.pack(row, minutes)
    if before is not None and tremor.same_values(before, row):
        row = before
    else:
        _replace(db, before, row)
    spans.append((row.first_start_at, row.last_end_at))
    said = [f"Kept: {counted(row.n, 'minute')} of tremor from {_when(row.first_start_at)} to {_when(row.last_end_at)} UTC."]
    others = of_files.tremor_series(db, participant_id, row.first_start_at, row.last_end_at, but_file_id=upload_file_id)
    same, different = tremor.compare(minutes, others)
    if same or different:
        said.append(
            f"{same + different} of these minutes came in other files too, {different} of them with other values: each counts once, "
            "as the newest file states it."
        )
    return said + _derive_overlapping(db, participant_id, spans)


def store_grasp(
    db: Session,
    session: StudySession,
    upload_file_id: int,
    hand: str | None,
    open_fist_s: NDArray[np.float64],
    implausible: NDArray[np.bool_],
) -> list[str]:
    """Keep one hand's grasp test of a session, and derive the session's grasp frequency (eq:grasp_speed).

    Args:
        db: the caller commits.
        session: whose test it was. upload_file_id: the file; the same file and hand again replace its earlier test. A file that belonged to
            another session no longer counts there. What was replaced stays as a removed row.
        hand: `left`, `right`, or None where the file does not say.
        open_fist_s: times of open fists, s, strictly increasing, shape [n].
        implausible: intervals too short or too long for a grasp, shape [n - 1]; they are kept and marked.

    Returns:
        Sentences for the upload's report.

    Raises:
        ValueError: shapes that do not agree, no open fist at all, times that do not increase.
    """
    times = np.asarray(open_fist_s, dtype=np.float64)
    marks = np.asarray(implausible, dtype=bool)
    if times.ndim != 1 or times.size == 0 or marks.shape != (times.size - 1,):
        raise ValueError(f"{times.shape} open fists need one mark per interval between them, not {marks.shape}")
    if not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
        raise ValueError("times of open fists must be numbers that increase")
    said = _take_from_other_sessions(db, session, upload_file_id)
    side = Hemisphere(hand) if hand else None
    known = (t for t in of_files.grasp_tests(db, session.id) if t.upload_file_id == upload_file_id and t.hand == side)
    before, packed = next(known, None), (times.astype("<f8").tobytes(), marks.tolist())
    if before is None or (before.open_fist_s_f64, before.implausible) != packed:
        row = GraspTest(session_id=session.id, upload_file_id=upload_file_id, hand=side, n=times.size)
        row.open_fist_s_f64, row.implausible = packed
        _replace(db, before, row)
    whose = f"{hand} hand" if hand else "hand not stated"
    return [*said, f"Session {session.id}: grasp test, {whose}, {times.size} open fists are kept.", *derive_for_session(db, session)]


def derive_for_session(db: Session, session: StudySession) -> list[str]:
    """Derive a session's QoCs from the files that are there, after an upload, a confirmation, or a change of its time or side.

    Returns:
        Sentences on what was derived, what was not and why, and where a person's value disagrees. Empty where no file speaks of it.
    """
    found = of_files.derive(db, session)
    if session.status != "confirmed":
        return [f"Session {session.id} is proposed: its outcomes are derived when it is confirmed."] if found else []
    if session.visit.locked:
        return [f"Session {session.id}: visit {session.visit.number} is locked, so that its outcomes stay as they are."] if found else []
    repository.lock_session(db, session)
    known = session.qoc
    followed = () if known is None else known.from_day
    # files without a value leave what the clinic day has
    free = {d.name: d for d in found if person_behind(session, d.name) is None and (d.value is not None or d.name not in followed)}
    if known is not None:
        # a derived value whose minutes no longer lie in the session is taken back
        gone = [n for n in known.derived if n not in {d.name for d in found}]
        free |= {n: Derived(n, None, "no uploaded file speaks of this session any more", ()) for n in gone}
    said = [f"Session {session.id}: {d.sentence}." for d in found if d.name in free]
    changed = [d for d in free.values() if not _same(getattr(known, d.name, None), d.value)]
    if changed:
        _add_revision(db, session, changed)
    for clash in disagreements(session, found):
        typed = "no value" if clash.typed is None else f"{stated(clash.typed, 4)} {clash.derived.unit}"
        said.append(
            f"Session {session.id}: {clash.author} entered {typed} for {clash.derived.label.lower()}, which stays; "
            f"the files give {clash.derived.sentence}. Compare them on the session's page."
        )
    return said


def give_up(db: Session, session: StudySession) -> None:
    """Keep the grasp tests of a proposal that is about to be deleted, as removed rows."""
    for row in of_files.grasp_tests(db, session.id):
        row.removed_at = now()
    db.flush()


def disagreements(session: StudySession, found: Sequence[Derived]) -> list[Disagreement]:
    """List values of a person that differ from what the files give; a value that the files cannot give disagrees with none."""
    clashes = []
    for derived in found:
        author = person_behind(session, derived.name)
        typed = getattr(session.qoc, derived.name, None)
        if author is not None and derived.value is not None and not _same(typed, derived.value):
            clashes.append(Disagreement(derived.name, typed, author, derived))
    return clashes


def person_behind(session: StudySession, name: str) -> str | None:
    """Return who typed, or took back, the present value of a QoC; None where no person did or where it was derived."""
    known = session.qoc
    if known is None or name in known.derived or name in known.from_day:
        return None
    author, before, was_derived = None, None, False
    for revision in session.qocs:
        value, derived = getattr(revision, name), name in (*revision.derived, *revision.from_day)
        if value != before or derived != was_derived:
            author, before, was_derived = revision.entered_by, value, derived
    return author


def follow_day(db: Session, session: StudySession, day_values: Mapping[str, float | None], entered_by: str, reason: str) -> None:
    """Add a revision where the QoCs that a session has from its clinic day alone are others by now.

    What a person typed for the session, or a file gave, stays. Same values, no revision.

    Args:
        db: the caller commits. session: confirmed, of a visit that is not locked.
        day_values: of each QoC that the day can have, in its unit; None where it says nothing, or contradicts itself.
        entered_by: who sent it. reason: kept with the revision.
    """
    repository.lock_session(db, session)
    known = session.qoc
    new = {
        name: value
        for name, value in day_values.items()
        if (known is None or name not in known.derived or getattr(known, name) is None)
        and person_behind(session, name) is None
        and not _same(getattr(known, name, None), value)
    }
    if new:
        from_day = sorted({*(known.from_day if known else ()), *new})
        add_revision(db, session, new, entered_by, reason, [n for n in (known.derived if known else ()) if n not in new], from_day)


def take_derived(db: Session, session: StudySession, name: str, shown: float, author: str) -> QocRevision:
    """Put the derived value of a QoC in the place of the one that a person typed.

    Args:
        shown: the derived value that the page showed. author: who takes it.

    Raises:
        Invalid: the files give another value by now, or none.
    """
    found = next((d for d in of_files.derive(db, session) if d.name == name and d.value is not None), None)
    if session.status != "confirmed" or found is None or found.value is None or abs(found.value - shown) > 1e-6 * max(1.0, abs(shown)):
        raise Invalid("The uploaded files give another value by now.", "Look at the value on this page and decide again.")
    repository.lock_session(db, session)
    return _add_revision(db, session, [found], author)


def add_revision(
    db: Session,
    session: StudySession,
    given: Mapping[str, Any],
    entered_by: str,
    reason: str | None,
    derived: Sequence[str],
    from_day: Sequence[str],
) -> QocRevision:
    """Add a revision under the session's lock: `given` values, the others as they are.

    `derived` names those that come from files, `from_day` those of the clinic day.
    """
    known = session.qoc
    merged = {name: getattr(known, name, None) for name in FIELDS} | dict(given)
    set_reason(db, reason)
    revision = QocRevision(
        session_id=session.id,
        revision=repository.qoc_revision(db, session.id) + 1,
        entered_by=entered_by,
        reason=reason,
        derived=sorted(derived),
        from_day=sorted(from_day),
        **merged,
    )
    db.add(revision)
    db.flush()
    db.expire(session, ["qocs"])
    return revision


def _add_revision(db: Session, session: StudySession, changed: Sequence[Derived], author: str | None = None) -> QocRevision:
    """Add a revision with derived values; the other QoCs stay."""
    files = sorted({i for d in changed for i in d.upload_file_ids})
    uploads = ", ".join(str(i) for i in sorted(set(repository.uploads_of_files(db, files).values())))
    reason = "; ".join(d.sentence for d in changed)
    origin = f"derived from upload {uploads}"[:254] if uploads else "derived from uploaded files"
    names = {d.name for d in changed} | set(session.qoc.derived if session.qoc else ())
    values = {d.name: d.value for d in changed}
    before = db.info.get("actor", {}).get("reason")
    from_day = [name for name in (session.qoc.from_day if session.qoc else ()) if name not in values]
    row = add_revision(db, session, values, author or origin, f"{origin}: {reason}" if author else reason, sorted(names), from_day)
    set_reason(db, before)  # what the caller writes next has its own reason
    return row


def _take_from_other_sessions(db: Session, session: StudySession, upload_file_id: int) -> list[str]:
    """Remove the values of a file from other sessions that it was attached to by mistake."""
    said = []
    elsewhere = [t for t in of_files.grasp_tests_of_file(db, upload_file_id) if t.session_id != session.id]
    for row in elsewhere:
        row.removed_at = now()
    db.flush()
    for session_id in sorted({t.session_id for t in elsewhere if t.session_id is not None}):
        said += [f"The grasp tests of this file no longer belong to session {session_id}."]
        said += derive_for_session(db, db.get_one(StudySession, session_id))
    return said


def _replace(db: Session, before: TremorSeries | GraspTest | None, row: TremorSeries | GraspTest) -> None:
    """Put a row in the place of another one, which stays as a removed row: of two that count the database would take one alone."""
    if before is not None:
        before.removed_at = now()
        db.flush()
    db.add(row)
    db.flush()


def _derive_overlapping(db: Session, participant_id: int, spans: Sequence[tuple[datetime, datetime]]) -> list[str]:
    said, without_start, touched = [], [], False
    for session in repository.sessions_of_participant(db, participant_id):
        if session.status != "confirmed":
            continue
        if session.started_at is None:
            without_start.append(session.id)
            continue
        start, stop = session.started_at.timestamp(), session.started_at.timestamp() + session.duration_s
        if any(first.timestamp() < stop and last.timestamp() > start for first, last in spans):
            touched = True
            said += derive_for_session(db, session)
    if without_start:
        listed = ", ".join(map(str, without_start[:20]))
        said.append(f"Confirmed sessions whose start nobody stated cannot be laid over these minutes: {listed}.")
    if not touched:
        # true whatever session is made of the same upload afterwards
        said.append("They count in every confirmed session with a start that they cover, also in one that is made later.")
    return said


def _in_order(
    start_unix_s: NDArray[np.float64], duration_s: NDArray[np.float64], fractions: NDArray[np.float64], any_tremor: NDArray[np.float64]
) -> Minutes:
    start, length = np.asarray(start_unix_s, dtype=np.float64), np.asarray(duration_s, dtype=np.float64)
    n = start.size
    if start.shape != (n,) or length.shape != (n,) or fractions.shape != (n, len(TREMOR_CLASSES)) or any_tremor.shape != (n,):
        raise ValueError(f"minutes must agree in number: {start.shape}, {length.shape}, {fractions.shape}, {any_tremor.shape}")
    if not np.all(np.isfinite(start)) or not np.all(length > 0) or not np.all(np.isfinite(length)):
        raise ValueError("every minute needs a begin and a length above 0 s")
    minutes = Minutes(start, length, np.asarray(fractions, dtype=np.float64), np.asarray(any_tremor, dtype=np.float64))
    if np.all(np.diff(start) >= 0):
        return minutes  # as exports are; a year of them is not copied for nothing
    return minutes.at(np.argsort(start, kind="stable"))


def _same(a: float | None, b: float | None) -> bool:
    if a is None or b is None:
        return a is b
    return abs(a - b) <= 1e-9 * max(1.0, abs(a))


def _when(moment: datetime) -> str:
    return moment.astimezone(UTC).strftime("%Y-%m-%d %H:%M")


def follow_stop(db: Session, session: StudySession, previous: str | None, reason: str, caller: Caller) -> None:
    """Let the adverse events follow a session's stop: a new one, its words corrected, or taken back.

    Args:
        session: with its stop. previous: the words of its stop until now. reason: of the change. caller: who made it.
    """
    after = session.stopped_reason
    if after == previous:
        return
    known = stops_of_session(db, session)
    if after is None:
        for event in known:
            event.revisions.append(_stop_revision(event, Severity.NONE, event.now.note, reason, caller))
    elif known:
        known[-1].revisions.append(_stop_revision(known[-1], known[-1].now.severity, after, reason, caller))
    else:
        event = AdverseEvent(participant_id=session.visit.participant_id, visit_id=session.visit_id, session_id=session.id)
        event.revisions.append(_stop_revision(event, Severity.NOT_STATED, after, None, caller))
        db.add(event)
    db.flush()


def _stop_revision(event: AdverseEvent, severity: Severity, note: str, reason: str | None, caller: Caller) -> AdverseEventRevision:
    serious = bool(event.revisions) and event.now.serious and severity is not Severity.NONE
    number = len(event.revisions) + 1
    details = ("relation", "ended_at", "action", "outcome") if event.revisions else ()
    kept: dict[str, Any] = {name: getattr(event.now, name) for name in details}
    kept |= {"revision": number, "serious": serious, "note": note, "reason": reason, "entered_by": caller.label}
    return AdverseEventRevision(kind=EventKind.STOPPED, severity=severity, **kept)
