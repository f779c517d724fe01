"""Tables as other programs save them give the same recording, or the same minutes, as the plain one."""

from __future__ import annotations

import numpy as np
import pytest

from ml.formats import DecodeOptions, UndecodableFile, decode, sniff
from ml.formats.tables import columns
from ml.formats.tables.columns import read_csv
from ml.formats.tables.redact import redact_table
from ml.formats.tables.strivepd import decode_strivepd

PLAIN = "t_s,beta [uV],amplitude_ma\n2,10.5,2.5\n4,11.5,2.0\n6,,2.0\n8,12.5,1.5\n"
BODY = PLAIN[PLAIN.index("\n") + 1 :]


def traces(path):
    assert sniff(path) == "csv"
    (recording,) = decode(path).recordings
    return {t.stream: (t.unit, t.t_end_first_s, [str(v) for v in t.values.tolist()], t.valid.tolist()) for t in recording.traces}


SPELLINGS = {
    "title rows": "Session of the afternoon\nexported by a program\n\n" + PLAIN,
    "title rows as wide as the table": "Session,,\nVersion 2,,\n" + PLAIN,
    "comments": "# a comment, with a comma\n# beta: nobody knows\n" + PLAIN,
    "a row of units": "t_s,beta,amplitude\ns,uV,mA\n" + BODY,
    "a row of units in brackets": "t_s,beta,amplitude\n[s],[uV],[mA]\n" + BODY,
    "milliseconds": "t_ms,beta [uV],amplitude_ma\n2000,10.5,2.5\n4000,11.5,2.0\n6000,,2.0\n8000,12.5,1.5\n",
    "pipes": PLAIN.replace(",", "|"),
    "pipes and decimal commas": PLAIN.replace(",", "|").replace(".", ","),
    "Latin-1 units": PLAIN.replace("uV", "\u00b5V").encode("latin-1"),
    "UTF-16 without a mark": PLAIN.encode("utf-16-le"),
    "UTF-16 without a mark, other order": PLAIN.encode("utf-16-be"),
    "UTF-16 with a mark": PLAIN.encode("utf-16"),
    "sep= and a title": "sep=;\nA title\n" + PLAIN.replace(",", ";"),
    "quoted": PLAIN.replace("10.5", '"10.5"'),
    "ISO times": "timestamp,beta [uV],amplitude_ma\n2024-03-14T10:05:50.000Z,10.5,2.5\n2024-03-14T10:05:52.000Z,11.5,2.0\n"
    "2024-03-14T10:05:54.000Z,,2.0\n2024-03-14T10:05:56.000Z,12.5,1.5\n",
    "ISO times over midnight": "time,beta [uV],amplitude_ma\n2024-03-14 23:59:58,10.5,2.5\n2024-03-15 00:00:00,11.5,2.0\n"
    "2024-03-15 00:00:02,,2.0\n2024-03-15 00:00:04,12.5,1.5\n",
}  # fmt: skip


@pytest.mark.parametrize("content", SPELLINGS.values(), ids=SPELLINGS)
def test_a_table_in_another_spelling_is_the_same_recording(write, tmp_path, content):
    path = write(content, "other.csv")
    assert traces(path) == traces(write(PLAIN))
    redact_table(path, tmp_path / "clean.csv", "csv", DecodeOptions())
    assert traces(tmp_path / "clean.csv") == traces(write(PLAIN))


def test_dates_are_said_to_be_read_from_the_first_row(write):
    notes = decode(write(SPELLINGS["ISO times"])).reports[0].repaired
    assert any("state its start with the upload" in text for text in notes)


@pytest.mark.parametrize("cell", ["soon", "12.5", "2024-13-40T10:00:00Z"])
def test_a_time_that_is_no_date_among_dates_is_refused_with_its_line(write, cell):
    with pytest.raises(UndecodableFile, match="is no date") as caught:
        decode(write(f"time,beta,amplitude_ma\n2024-03-14T10:00:00Z,1,1\n{cell},1,1\n"))
    assert caught.value.where == "line 3, column time"


@pytest.mark.parametrize("stamp", ["1710410750", "1710410750000", "1710410750000000"])
@pytest.mark.parametrize("header", ["t_s", "timestamp", "time"])
def test_unix_times_are_refused_by_name_under_every_header(write, stamp, header):
    last = str(int(stamp) + 2 * 10 ** (len(stamp) - 10))
    with pytest.raises(UndecodableFile, match="the times are Unix"):
        decode(write(f"{header},beta,amplitude_ma\n{stamp},1,1\n{last},1,1\n"))


def test_titles_move_no_line_number(write):
    with pytest.raises(UndecodableFile) as caught:
        decode(write("A title\n\n" + PLAIN.replace("11.5", "high")))
    assert caught.value.where == "line 5, column beta [uV]"


def test_a_row_of_words_below_the_header_is_no_row_of_units(write):
    with pytest.raises(UndecodableFile, match="is text, not a number"):
        decode(write("t_s,beta,amplitude_ma\nnow,low,off\n" + BODY))


def test_plain_tables_are_read_the_same_fast_and_slowly(write, monkeypatch):
    rng = np.random.default_rng(5)
    pairs = zip(rng.normal(size=500).tolist(), rng.random(500).tolist(), strict=True)
    cells = [[f"{2 * i + 2}", repr(x), f"{y:.3e}", "a word"] for i, (x, y) in enumerate(pairs)]
    cells[7][1], cells[9][1], cells[11][2] = "", "NaN", "1e999"
    path = write("t_s,beta,amplitude_ma,note\n" + "\n".join(",".join(row) for row in cells))
    fast = read_csv(path, DecodeOptions())
    monkeypatch.setattr(columns, "read_plain", lambda *_: None)
    slow = read_csv(path, DecodeOptions())
    assert fast.lines.tolist() == slow.lines.tolist()
    assert (fast.names, fast.units, fast.ignored, fast.notes) == (slow.names, slow.units, slow.ignored, slow.notes)
    for role in slow.values:
        np.testing.assert_array_equal(fast.values[role], slow.values[role])


WIDE = "time,mild,moderate,none,slight,strong,unknown\n2024-03-14T10:05:00Z,0.1,0.0,0.5,0.2,0.0,0.2\n2024-03-14T10:06:00Z,0,0,1,0,0,0\n"
TREMOR = {
    "Apple's names": "startDate,endDate,percentUnknown,percentNone,percentSlight,percentMild,percentModerate,percentStrong\n"
    "2024-03-14T10:05:00Z,2024-03-14T10:06:00Z,0.2,0.5,0.2,0.1,0,0\n2024-03-14T10:06:00Z,2024-03-14T10:07:00Z,0,1,0,0,0,0\n",
    "Apple's names and dates": "Start Date,End Date,Percent Unknown,Percent None,Percent Slight,Percent Mild,Percent Moderate,"
    "Percent Strong\n"
    "2024-03-14 10:05:00 +0000,2024-03-14 10:06:00 +0000,0.2,0.5,0.2,0.1,0,0\n"
    "2024-03-14 10:06:00 +0000,2024-03-14 10:07:00 +0000,0,1,0,0,0,0\n",
    "per cent": WIDE.replace("0.1,0.0,0.5,0.2,0.0,0.2", "10,0,50,20,0,20").replace("0,0,1,0,0,0", "0,0,100,0,0,0"),
    "per cent in the headers": "time,mild [%],moderate [%],none [%],slight [%],strong [%],unknown [%]\n"
    "2024-03-14T10:05:00Z,10,0,50,20,0,20\n2024-03-14T10:06:00Z,0,0,100,0,0,0\n",
}


@pytest.mark.parametrize("text", TREMOR.values(), ids=TREMOR)
def test_tremor_in_another_spelling_is_the_same_minutes(write, tmp_path, text):
    path = write(text)
    assert sniff(path) == "tremor"
    (got,), (plain,) = decode_strivepd(path).outcomes, decode_strivepd(write(WIDE, "wide.csv")).outcomes
    redact_table(path, tmp_path / "clean.csv", "tremor", DecodeOptions())
    (clean,) = decode_strivepd(tmp_path / "clean.csv").outcomes
    for one in (got, clean):
        for name in ("start_unix_s", "duration_s", "fractions", "any_tremor"):
            np.testing.assert_allclose(getattr(one, name), getattr(plain, name), atol=1e-12)


def test_one_minute_without_shares_does_not_hide_that_the_others_are_in_per_cent(write):
    text = TREMOR["per cent"] + "2024-03-14T10:07:00Z,,,,,,\n"
    (got,) = decode_strivepd(write(text)).outcomes
    np.testing.assert_allclose(got.fractions[:2].sum(axis=1), 1.0)


def test_an_interval_of_tremor_that_ends_before_it_begins_is_refused(write):
    bad = TREMOR["Apple's names"].replace("2024-03-14T10:07:00Z", "2024-03-14T10:05:30Z")
    with pytest.raises(UndecodableFile, match="ends before it begins") as caught:
        decode_strivepd(write(bad))
    assert caught.value.where == "line 3, column endDate"


def test_shares_that_are_neither_fractions_nor_per_cent_are_refused(write):
    with pytest.raises(UndecodableFile, match="a fraction outside 0 to 1"):
        decode_strivepd(write(WIDE.replace("0.1,0.0,0.5", "7,0.0,0.5")))


def test_dates_that_go_back_by_an_hour_name_the_changed_clock(write):
    night = [f"2026-10-25T02:59:{30 + 2 * k:02d}" for k in range(15)] + [f"2026-10-25T02:00:{2 * k:02d}" for k in range(15)]
    with pytest.raises(UndecodableFile) as refused:
        decode(write("time,beta,amplitude_ma\n" + "".join(f"{t},1.5,1\n" for t in night)))
    assert (refused.value.what, refused.value.where) == ("the times go back by an hour", "line 17, column time")
    zoned = [f"{t}{'+02:00' if k < 15 else '+01:00'}" for k, t in enumerate(night)]
    (recording,) = decode(write("time,beta,amplitude_ma\n" + "".join(f"{t},1.5,1\n" for t in zoned))).recordings
    assert recording.duration_s == 60.0


def test_a_time_of_day_is_refused_with_what_a_time_is(write):
    with pytest.raises(UndecodableFile, match="seconds from the session's start, or as an ISO 8601 date"):
        decode(write("time;beta;amplitude_ma\n10:00:02;1,5;1,0\n10:00:04;1,5;1,0\n"))
