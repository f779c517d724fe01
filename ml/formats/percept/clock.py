"""The implant's clock of a Percept report: how far it is ahead of the programmer's, which is taken for UTC.

Every date of a report but SessionDate and SessionEndDate is on it. Thirteen public reports of six implants had it 4.5 to 37.6 min ahead.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Any

from ml.formats.facts.clocks import Moment, Offset, estimate, lead_in_words, unknown
from ml.formats.percept.report_json import has_zone, inside, moment
from ml.formats.recording import FileReport

OUTSIDE_S = 600.0
"""Packets so far outside the session, as DeviceDateTime limits it, are dated by another clock."""
LONGEST_S = 24 * 3600.0
"""No session with the programmer lasts longer; it limits one whose end has no date."""
WORTH_A_LOOK_S = 3600.0
"""A clock that is off by more is flagged for a person to confirm."""


def implant_clock(report: dict[str, Any], packets: Iterable[datetime | None]) -> Offset:
    """Estimate the offset of the implant's clock of a report.

    Args:
        report: as it was read.
        packets: dates of the first packets of its runs, which must be within the session.
    """
    begin, end = (moment(inside(report, "DeviceInformation", part, "DeviceDateTime")) for part in ("Initial", "Final"))
    stated = moment(report.get("SessionDate")), moment(report.get("SessionEndDate"))
    if begin and (unzoned := [n for n in ("SessionDate", "SessionEndDate") if moment(report.get(n)) and not has_zone(report.get(n))]):
        # a local time looks like a clock that is hours off
        return unknown("implant", f"{' and '.join(unzoned)} {'has' if len(unzoned) == 1 else 'have'} no zone, and may be local time")
    found = estimate("implant", [(begin, stated[0]), (end, stated[1])])
    if not found.known:
        missing = [name for name, when in (("DeviceDateTime", begin or end), ("SessionDate", stated[0] or stated[1])) if when is None]
        return unknown("implant", f"the report has no {' and no '.join(missing)}") if missing else found
    first = begin or found.pairs[0][0] - timedelta(seconds=LONGEST_S)
    last = end or found.pairs[-1][0] + timedelta(seconds=LONGEST_S)
    margin = timedelta(seconds=OUTSIDE_S)
    if outside := [p for p in packets if p is not None and not first - margin <= p <= last + margin]:
        return unknown("implant", f"{len(outside)} runs are dated outside the session that DeviceDateTime limits")
    return replace(found, doubtful=found.doubtful or any(abs(ahead) > WORTH_A_LOOK_S for _, ahead in found.pairs))


def to_utc(offset: Offset, value: datetime) -> datetime:
    """Convert a date of the report, on the implant's clock, to UTC; it stays where the offset is unknown."""
    return offset.utc(Moment("implant", value))


def describe_clock(offset: Offset, report: dict[str, Any], packets: Iterable[datetime | None], file_report: FileReport) -> None:
    """Add to the file's report how far the implant's clock was ahead, or that it is unknown."""
    if offset.ahead_s is None:
        dates = [p for p in packets if p is not None]
        stated = moment(report.get("SessionDate"))
        both = f"SessionDate says {stated:%Y-%m-%d}, the packets {dates[0]:%Y-%m-%d}. " if stated and dates else ""
        file_report.flagged.append(
            f"the implant's clock is unknown: {offset.why}. {both}Its dates are used as they are, and may differ from UTC. Compare the "
            "start with your notes before you trust the visit, the outcomes by time, or a match with the other implant"
        )
        return
    begin, end = offset.ahead_s, offset.pairs[-1][1]
    drift = f" at the begin, {lead_in_words(end)} at the end" if abs(end - begin) >= 2.0 else ""
    text = (
        f"the implant's clock is {lead_in_words(begin)} UTC{drift} (within {offset.uncertainty_s:.0f} s, by {offset.why}): "
        "all its dates are corrected by that"
    )
    if offset.doubtful:
        file_report.flagged.append(f"{text}. The estimate is doubtful: compare the start with your notes")
    elif abs(begin) >= 60.0 or abs(end) >= 60.0:
        file_report.flagged.append(text)
    else:
        file_report.understood.append(text)
