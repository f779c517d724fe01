"""QoCs of a session from uploaded files, with everything that they rest on. Reads only; `app.study.outcomes.service` stores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.platform.numbers import stated
from app.study import repository
from app.study.outcomes import tremor
from app.study.outcomes.tremor import SessionMinutes
from app.study.recordings.facts import unknown_clock
from app.tables.outcomes import GraspTest, TremorSeries
from app.tables.participants import CharacteristicsVersion, Hemisphere
from app.tables.sessions import StudySession
from ml.outcomes import BY_FIELD
from ml.qoc import PLAUSIBLE_INTERVAL_S, TremorReading, grasp_frequency, read_tremor

# Queries of what tremor and grasp files gave.


def tremor_series(
    db: Session, participant_id: int, start: datetime, stop: datetime, but_file_id: int | None = None
) -> Sequence[TremorSeries]:
    """Load tremor files that reach into a stretch of time, oldest first. One file can be excluded: each may be a year."""
    reaching = (TremorSeries.last_end_at > start) & (TremorSeries.first_start_at < stop)
    own = select(TremorSeries).where(TremorSeries.participant_id == participant_id, reaching, TremorSeries.removed_at.is_(None))
    if but_file_id is not None:
        own = own.where(TremorSeries.upload_file_id != but_file_id)
    return db.scalars(own.order_by(TremorSeries.upload_file_id)).all()


def tremor_series_of_file(db: Session, participant_id: int, upload_file_id: int) -> TremorSeries | None:
    """Load the minutes of tremor that a file gave."""
    own = (TremorSeries.participant_id == participant_id) & (TremorSeries.upload_file_id == upload_file_id)
    return db.scalar(select(TremorSeries).where(own, TremorSeries.removed_at.is_(None)))


def grasp_tests(db: Session, session_id: int) -> Sequence[GraspTest]:
    """Load the grasp tests of a session, oldest file first."""
    mine = (GraspTest.session_id == session_id) & GraspTest.removed_at.is_(None)
    return db.scalars(select(GraspTest).where(mine).order_by(GraspTest.upload_file_id, GraspTest.id)).all()


def grasp_tests_of_file(db: Session, upload_file_id: int) -> Sequence[GraspTest]:
    """Load the grasp tests that a file gave, of any session."""
    return db.scalars(select(GraspTest).where(GraspTest.upload_file_id == upload_file_id, GraspTest.removed_at.is_(None))).all()


MIN_COVERAGE = 0.9
"""Share of a session that minutes must cover. The rest counts as time without tremor, since the paper divides by the whole session: with
less, the QoC would be too low.
"""

MAX_UNKNOWN = 0.5
"""Share of a session that the watch may call unknown (active movement). It counts as time without tremor too, by the same division."""


UNKNOWN_CLOCK = "the clock of the recording is unknown, so that the watch's minutes cannot be put to it; state its offset"


@dataclass(frozen=True)
class Derived:
    """A QoC as the files give it.

    Attributes:
        name: member of the QoCs. value: None where the files do not suffice.
        basis: what it rests on, or why there is none. upload_file_ids: the files that it rests on.
    """

    name: str
    value: float | None
    basis: str
    upload_file_ids: tuple[int, ...]

    @property
    def label(self) -> str:
        """The QoC as a page names it."""
        return BY_FIELD[self.name].label

    @property
    def unit(self) -> str:
        """Its unit."""
        return BY_FIELD[self.name].entry_unit

    @property
    def sentence(self) -> str:
        """Value and basis in words."""
        what = self.label.lower()
        return f"no {what} derived: {self.basis}" if self.value is None else f"{what} {stated(self.value, 4)} {self.unit} ({self.basis})"


@dataclass(frozen=True)
class TremorOutcome:
    """The minutes that count for a session that begins at `start_unix_s`, both readings of them, and the QoC."""

    minutes: SessionMinutes
    start_unix_s: float
    reading: TremorReading
    derived: Derived


@dataclass(frozen=True, eq=False)
class GraspView:
    """One hand's test.

    Attributes:
        open_fist_s: shape [n], s. intervals_s, implausible: shape [n - 1].
        hz, plausible_hz: eq:grasp_speed over all intervals, and over the plausible ones alone; None where undefined.
        role: what the test does for the QoC, in words. counts: whether it is part of it.
    """

    row: GraspTest
    open_fist_s: NDArray[np.float64]
    intervals_s: NDArray[np.float64]
    implausible: NDArray[np.bool_]
    hz: float | None
    plausible_hz: float | None
    role: str = ""
    counts: bool = False

    @property
    def whose(self) -> str:
        """The hand in words."""
        return f"{self.row.hand} hand" if self.row.hand else "hand not stated"


@dataclass(frozen=True)
class GraspOutcome:
    """All grasp tests of a session, the newest of each hand first, and the QoC."""

    tests: list[GraspView]
    derived: Derived


def derive(db: Session, session: StudySession) -> list[Derived]:
    """Derive the QoCs that files contain; empty where none does."""
    return [o.derived for o in (tremor_outcome(db, session), grasp_outcome(db, session)) if o is not None]


def tremor_outcome(db: Session, session: StudySession) -> TremorOutcome | None:
    """Derive tremor from the minutes over a session (eq:tremor_severity); None where no minute is in it, or its start is not known."""
    if session.started_at is None or session.duration_s <= 0:
        return None
    start = session.started_at.timestamp()
    stop_at = session.started_at + timedelta(seconds=session.duration_s)
    series = tremor_series(db, session.visit.participant_id, session.started_at, stop_at)
    uploads = repository.uploads_of_files(db, [s.upload_file_id for s in series])
    names = {file: f"upload {upload}" for file, upload in uploads.items()}
    chosen = tremor.within(series, start, start + session.duration_s, names)
    if not chosen.upload_file_ids and not chosen.notes:
        return None
    m = chosen.minutes
    unknown = any(s.is_control and unknown_clock(s.recording) for s in session.segments)
    reading = read_tremor(m.start_unix_s, m.duration_s, m.fractions, start, session.duration_s)
    value, basis = (None, UNKNOWN_CLOCK) if unknown else _tremor_value(reading)
    files = tuple(sorted(set(chosen.upload_file_ids)))
    return TremorOutcome(chosen, start, reading, Derived("tremor_percent", value, "; ".join([basis, *chosen.notes]), files))


def _tremor_value(reading: TremorReading) -> tuple[float | None, str]:
    """Return the reading that counts, where the minutes suffice, and what it rests on."""
    whole = reading.session_s
    covered = f"{reading.covered_s / 60:.1f} of {whole / 60:.1f} min covered"
    if reading.undivided_s:
        covered += f", besides {reading.undivided_s / 60:.1f} min that tell only all tremor together"
    if reading.covered_s < MIN_COVERAGE * whole - 1e-6:
        return None, f"{covered}; {100 * MIN_COVERAGE:.0f} % of the session are needed"
    covered += f", {reading.unknown_s / 60:.1f} min unknown"
    untold = reading.covered_s - sum(reading.class_seconds.values())
    if untold > 1:
        covered += f", {untold / 60:.1f} min of no class"
    if reading.unknown_s + max(0.0, untold) > MAX_UNKNOWN * whole:
        return None, f"{covered}; at most {100 * MAX_UNKNOWN:.0f} % of the session may be"
    return reading.duration_weighted, f"duration-weighted, {covered}; by each minute's largest class {stated(reading.arg_max, 4)} %"


def grasp_outcome(db: Session, session: StudySession) -> GraspOutcome | None:
    """Derive the grasp frequency from a session's tests (eq:grasp_speed); None where there is no test.

    Of several tests of one hand the newest counts. The hand is the participant's, as their characteristics state it: the one that goes with
    the symptoms, as in the paper. A test of the other hand alone gives no value until a person enters it. Only where no hand is stated, the
    one contralateral to the session's hemisphere is taken, else the mean of both.
    """
    rows = grasp_tests(db, session.id)
    if not rows:
        return None
    newest = {row.hand: row for row in rows}
    views = [_view(row) for row in reversed(rows)]
    current = session.visit.participant.current_characteristics
    by_hand = {v.row.hand: v for v in views if newest[v.row.hand] is v.row}
    counted, how = _of_own_hand(by_hand, current) if current and current.hand else _which_hands(by_hand, session.hemisphere)
    value, basis = _grasp_value(counted, how)
    used = {v.row.id for v in counted}
    tests = [_with_role(v, newest, used) for v in views]
    files = tuple(sorted({v.row.upload_file_id for v in counted}))
    return GraspOutcome(tests, Derived("grasp_hz", value, basis, files))


def _of_own_hand(views: Mapping[Hemisphere | None, GraspView], known: CharacteristicsVersion) -> tuple[list[GraspView], str]:
    """Select the test of the participant's hand, or one whose file names no hand; none where only the other hand was tested, and why."""
    hand = Hemisphere(known.hand)  # type: ignore[arg-type]
    if hand in views:
        return [views[hand]], f"{hand} hand, the participant's by the characteristics (version {known.version})"
    if None in views:
        return [views[None]], f"hand not stated in the file; taken for the participant's, the {hand} one"
    tested = " and ".join(v.whose for v in views.values())
    return [], (
        f"{tested} tested, but the participant's hand is the {hand} one by the characteristics (version {known.version}): correct the one "
        "that is wrong, or enter the frequency by hand if it shall count"
    )


def _which_hands(views: Mapping[Hemisphere | None, GraspView], hemisphere: Hemisphere | None) -> tuple[list[GraspView], str]:
    """Select the tests that count, and say why these."""
    if len(views) == 1:
        view = next(iter(views.values()))
        if hemisphere is not None and view.row.hand == hemisphere:
            return [view], f"{view.whose}, on the side of the stimulated {hemisphere} hemisphere: the other hand was not tested"
        return [view], view.whose
    other = Hemisphere(hemisphere).opposite if hemisphere else None
    if other is not None and other in views:
        return [views[other]], f"{other} hand, contralateral to the {hemisphere} hemisphere; the participant's hand is not stated"
    why = "the session names no hemisphere" if hemisphere is None else f"no test of the {other} hand"
    both = sorted(views.values(), key=lambda v: v.row.hand or "")
    return both, f"mean of {' and '.join(v.whose for v in both)}: {why}"


def _grasp_value(counted: list[GraspView], how: str) -> tuple[float | None, str]:
    if not counted:
        return None, how
    undefined = [v for v in counted if v.hz is None]
    if undefined:
        return None, f"{how}; fewer than two open fists ({', '.join(v.whose for v in undefined)})"
    low, high = PLAUSIBLE_INTERVAL_S
    if odd_tests := [v for v in counted if v.implausible.all()]:
        whose = ", ".join(v.whose for v in odd_tests)
        return None, f"{how}; every interval lies outside {low:g} to {high:g} s ({whose}): are its times in the unit that the header says?"
    known = [v.hz for v in counted if v.hz is not None]
    value = float(np.mean(known))
    basis = f"{how}, {' + '.join(str(v.open_fist_s.size) for v in counted)} open fists"
    if odd := sum(int(v.implausible.sum()) for v in counted):
        without = [v.plausible_hz for v in counted if v.plausible_hz is not None]
        basis += f", {odd} intervals outside {low:g} to {high:g} s counted"
        left = f"without them {stated(float(np.mean(without)), 4)} Hz" if len(without) == len(counted) else "nothing left without them"
        basis += f", {left}"
    fastest = BY_FIELD["grasp_hz"].below  # a tracker that gives more has lost the hand
    if fastest is not None and value >= fastest:
        return None, f"{basis}; {stated(value, 4)} Hz is faster than any hand"
    return value, basis


def _view(row: GraspTest) -> GraspView:
    times = np.frombuffer(row.open_fist_s_f64, "<f8").astype(np.float64)
    intervals, implausible = np.diff(times), np.array(row.implausible, dtype=bool)
    plausible = intervals[~implausible]
    return GraspView(
        row,
        times,
        intervals,
        implausible,
        grasp_frequency(times) if times.size > 1 else None,
        float(1.0 / plausible.mean()) if plausible.size else None,
    )


def _with_role(view: GraspView, newest: Mapping[Hemisphere | None, GraspTest], used: set[int]) -> GraspView:
    if newest[view.row.hand] is not view.row:
        return replace(view, role="replaced by a newer test of this hand")
    return replace(view, role="counts", counts=True) if view.row.id in used else replace(view, role="the other hand counts")


# What is asked about unusual values before they are kept: typed, and a person's word answers it.
