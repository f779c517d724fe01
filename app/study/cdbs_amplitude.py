"""The cDBS amplitude in force: what every amplitude fraction is a fraction of."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import date
from typing import overload

from app.platform.errors import Invalid
from app.study.settings_types import CDBS_MA
from app.tables.participants import Hemisphere, Participant, SettingsVersion
from app.tables.sessions import StudySession
from app.tables.visits import Visit


def stated_at(visit: Visit, hemisphere: Hemisphere | None, program: int | None = 0) -> float | None:
    """Return the cDBS amplitude that a visit states for a hemisphere and program, mA; None where it states none.

    A program of which the visit says nothing has the amplitude of program 0, under which an amplitude without a program is stored.

    Args:
        hemisphere: None where it is not known.
        program: None where it is not known which one will run: program 0, else the only amplitude that is stated.

    Raises:
        Invalid: the visit states several, and nothing says which one is meant; an amplitude that no stimulator gives.
    """
    sides = [a for a in visit.cdbs_amplitudes if hemisphere in (None, a.hemisphere)]
    rows = [a for a in sides if a.program == program] or [a for a in sides if a.program == 0] or (sides if program is None else [])
    if len(rows) > 1:
        if len({a.hemisphere for a in rows}) > 1:
            what = f"No hemisphere is named, and visit {visit.number} has cDBS amplitudes for both."
            raise Invalid(what, "Set the session's hemisphere; for a bundle, name it: left or right.")
        raise Invalid(f"Visit {visit.number} states cDBS amplitudes of several programs.", "State the amplitude of program 0.")
    return plausible(rows[0].amplitude_ma, f"Visit {visit.number} states") if rows else None


def in_force(visit: Visit, hemisphere: Hemisphere | None, settings: SettingsVersion, program: int = 0, alone: bool = True) -> float | None:
    """Return the cDBS amplitude of a visit's hemisphere and program, mA, else the settings' shorthand; None where none is stated.

    Args:
        settings: the participant's present ones. alone: no other program of this side stimulates; else the amplitude stated for another
            program says nothing about this one.

    Raises:
        Invalid: as `stated_at`.
    """
    if not alone:
        of_side = [a for a in visit.cdbs_amplitudes if hemisphere in (None, a.hemisphere)]
        if of_side and not any(a.program == program for a in of_side):
            return None
    stated = stated_at(visit, hemisphere, program)
    usual = held_settings(visit, settings).cdbs_amplitude_ma
    return plausible(usual, "The participant's settings state") if stated is None else stated


def held_settings(visit: Visit, settings: SettingsVersion) -> SettingsVersion:
    """Return the settings whose cDBS amplitude a visit uses where it states none: a locked one uses those at its lock.

    A new amplitude says nothing of days that are closed; the fractions, energies and signatures of those stay as they were.

    Args:
        settings: the participant's present ones, by which an open visit goes.
    """
    if not visit.locked or visit.locks[-1].settings_version_id is None:
        return settings
    return next(v for v in visit.participant.settings if v.id == visit.locks[-1].settings_version_id)


def of_session(session: StudySession, settings: SettingsVersion, program: int = 0, alone: bool = True) -> float | None:
    """Return the cDBS amplitude in force for a session, mA, as `in_force`; None where none is stated. Raises Invalid as `stated_at`."""
    return in_force(session.visit, session.hemisphere, settings, program, alone)


def lacking(visit: Visit, hemisphere: Hemisphere | None, settings: SettingsVersion, program: int = 0) -> str:
    """Say why no cDBS amplitude is in force for a hemisphere and program of a visit, naming those that are stated.

    Args:
        settings: the participant's present ones.
    """
    if visit.cdbs_amplitudes:
        stated = "; ".join(f"{a.hemisphere}, program {a.program}" for a in visit.cdbs_amplitudes)
        wanted = f"{f'the {hemisphere}' if hemisphere else 'an unnamed'} hemisphere, program {program}"
        return f"visit {visit.number} states the cDBS amplitude of {stated}, and none of {wanted}"
    if visit.locked and settings.cdbs_amplitude_ma is not None:
        return f"the cDBS amplitude was stated after visit {visit.number} was locked"
    return "nobody has stated the cDBS amplitude"


def in_force_now(participant: Participant, hemisphere: Hemisphere | None) -> float:
    """Return the cDBS amplitude of the newest visit that states one (of this hemisphere), mA, else the settings' shorthand.

    The newest is that of the latest date: an earlier day that was entered late has a higher number.

    Raises:
        Invalid: as `stated_at`, or none is stated.
    """
    for visit in _newest_first(participant.visits):
        stated = stated_at(visit, hemisphere, None)
        if stated is not None:
            return stated
    shorthand = plausible(participant.current_settings.cdbs_amplitude_ma, "The participant's settings state")
    if shorthand is None:
        side = f" of the {hemisphere} hemisphere" if hemisphere else ""
        raise Invalid(f"The cDBS amplitude{side} is not known.", "Set cdbs_amplitude_ma in the participant's settings or at a visit.")
    return shorthand


def _newest_first(visits: Iterable[Visit]) -> list[Visit]:
    """Sort visits by date, the latest first; one without a date keeps the place of its number."""
    day, found = date.min, []
    for visit in sorted(visits, key=lambda v: v.number):
        # a day before that of a lower number is its own, and not that of the visits after it
        day = max(day, visit.date or day)
        found.append((visit.date or day, visit.number, visit))
    return [visit for _, _, visit in sorted(found, key=lambda row: row[:2], reverse=True)]


@overload
def plausible(amplitude_ma: float, who: str) -> float: ...
@overload
def plausible(amplitude_ma: None, who: str) -> None: ...
@overload
def plausible(amplitude_ma: float | None, who: str) -> float | None: ...
def plausible(amplitude_ma: float | None, who: str) -> float | None:
    """Return a stated cDBS amplitude, mA. Raises Invalid for one that earlier versions accepted: fractions of it would be no numbers."""
    if amplitude_ma is None or CDBS_MA.low <= amplitude_ma <= CDBS_MA.high:
        return amplitude_ma
    raise Invalid(
        f"{who} a cDBS amplitude of {amplitude_ma:g} mA, outside {CDBS_MA.low:g} to {CDBS_MA.high:g} mA: no fraction follows from it.",
        "Correct the amplitude.",
    )
