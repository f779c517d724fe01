"""Dates as spreadsheets and people write them, in tremor exports and mapped tables: the true moment, or a refusal."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats import UndecodableFile, decode
from ml.formats.tables.cells.dates import ChangedClocks, in_zone, named_month, spreadsheet_date, zone_named

HEAD = "{time},none,slight,mild,moderate,strong,unknown\n"
NOON = datetime(2026, 3, 5, 14, 10, tzinfo=UTC)


def minute(write, header, cell):
    """Read the one minute of a tremor export: its start, and what is flagged."""
    path = write(HEAD.format(time=header) + f"{cell},1,0,0,0,0,0\n")
    decoded = decode(path)
    return datetime.fromtimestamp(decoded.outcomes[0].start_unix_s[0], UTC), repr(decoded.reports[0].flagged)


@pytest.mark.parametrize(
    ("header", "cell"),
    [
        ("time (UTC+1)", "2026-03-05 15:10:00"),
        ("time [Europe/Berlin]", "2026-03-05 15:10:00"),
        ("time (UTC-05:00)", "2026-03-05 09:10:00"),
        ("time [+0530]", "2026-03-05 19:40:00"),
        ("time (UTC)", "05-Mar-2026 14:10:00"),
        ("time (UTC+1)", '"Mar 5, 2026, 3:10 PM"'),
        ("time (UTC+1)", '"Mar 5, 2026, 3:10\u202fPM"'),
        ("time (UTC+1)", "46086.6319444444"),
        ("time (UTC+1)", "2026-03-05T14:10:00Z"),
    ],
)
def test_a_time_with_the_zone_of_its_header_is_the_moment(write, header, cell):
    found, flagged = minute(write, header, cell)
    assert abs((found - NOON).total_seconds()) < 0.01
    assert "without a zone" not in flagged


@pytest.mark.parametrize("cell", ["05-Mar-2026 14:10:00", "5 March 2026 14:10", "46086.5902777778"])
def test_a_time_without_a_zone_counts_as_utc_and_is_flagged(write, cell):
    found, flagged = minute(write, "time", cell)
    assert abs((found - NOON).total_seconds()) < 0.01
    assert "1 times without a zone were read as UTC" in flagged


def test_a_time_that_its_zone_shows_twice_is_refused(write):
    with pytest.raises(UndecodableFile, match="twice or never"):
        minute(write, "time [Europe/Berlin]", "2026-10-25 02:30:00")


@given(st.datetimes(datetime(2001, 1, 1), datetime(2098, 1, 1)))
def test_a_day_number_and_a_month_name_are_the_date_that_was_written(when):
    when = when.replace(microsecond=0)
    days = (when - datetime(1899, 12, 30)) / timedelta(days=1)
    found = spreadsheet_date(days)
    assert found is not None
    assert abs((found - when).total_seconds()) < 0.01
    for form in ("%d-%b-%Y %H:%M:%S", "%d %B %Y %H:%M:%S", "%b %d, %Y %I:%M:%S %p"):
        assert named_month(when.strftime(form)) == when


@pytest.mark.parametrize("text", ["05-Foo-2026 10:00", "31 Feb 2026 10:00", "05.03.2026 10:00", "Mar 5, 2026 13:00 PM", "Mar 2026"])
def test_what_is_no_date_is_none(text):
    assert named_month(text) is None


@pytest.mark.parametrize("text", ["s", "EST", "mA", "UTC+25", "Mars/Crater", ""])
def test_what_is_no_zone_is_none(text):
    assert zone_named(text) is None


def test_no_day_number_is_a_time_of_the_day_or_a_unix_time():
    assert [spreadsheet_date(x) for x in (0.5, 1_767_600_000.0, -3.0)] == [None] * 3
    with pytest.raises(ChangedClocks):
        in_zone(datetime(2026, 3, 29, 2, 30), ZoneInfo("Europe/Berlin"))
