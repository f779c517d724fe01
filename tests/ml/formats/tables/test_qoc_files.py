from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats import UndecodableFile, decode, redact, sniff
from ml.formats.tables.grasps import decode_grasps
from ml.formats.tables.strivepd import decode_strivepd
from ml.qoc import TREMOR_CLASSES, grasp_frequency


@pytest.fixture
def write(tmp_path):
    def make(text):
        path = tmp_path / "x.csv"
        path.write_text(text)
        return path

    return make


@pytest.mark.parametrize(
    "text",
    [
        "t_s\n1.0\n1.5\n2.0\n2.5\n",
        "Time (s)\n1.0\n1.5\n2.0\n2.5\n",
        "t_us\n1000000\n1500000\n2000000\n2500000\n",
        "t_s;n\n1,0;1\n1,5;2\n2,0;3\n2,5;4\n",
    ],
)
def test_open_fists_in_seconds_or_microseconds_give_two_grasps_a_second(write, text):
    (hand,) = decode_grasps(write(text)).outcomes
    assert hand.hand is None
    assert grasp_frequency(hand.open_fist_s) == pytest.approx(2.0)


def test_a_column_of_hands_gives_one_test_per_hand(write):
    decoded = decode_grasps(write("t_s,hand\n1,L\n1.1,right\n2,left\n2.6,R\n"))
    assert {h.hand: h.open_fist_s.tolist() for h in decoded.outcomes} == {"left": [1.0, 2.0], "right": [1.1, 2.6]}


def test_implausible_intervals_are_flagged_and_kept(write):
    decoded = decode_grasps(write("t_s\n0\n0.05\n1\n5\n"))
    assert decoded.outcomes[0].implausible.tolist() == [True, False, True]
    assert decoded.outcomes[0].open_fist_s.size == 4
    assert "2 intervals" in decoded.reports[0].flagged[0]


def test_a_single_open_fist_is_kept_and_said_to_be_too_few(write):
    assert any("fewer than two" in text for text in decode_grasps(write("t_s\n1\n")).reports[0].flagged)


def test_closed_fists_are_not_counted(write):
    rows = "".join(f"{k},open,R\n{k + 0.5},Closed,R\n" for k in range(20))
    decoded = decode_grasps(write(f"t_s,event,hand\n{rows}"))
    assert grasp_frequency(decoded.outcomes[0].open_fist_s) == pytest.approx(1.0)
    assert decoded.reports[0].ignored == ["20 rows of closed fists"]


@pytest.mark.parametrize(
    ("text", "what", "where"),
    [
        ("t_s\n1\n1\n", "must increase", "line 3"),
        ("t_s,n\n1,2\n\n1,2,3\n", "3 cells where the header has 2", "line 4"),
        ("t_s,hand\n1,B\n", "unknown hand", "line 2"),
        ("t_s,event\n1,open\n2,wave\n", "unknown event", "line 3, column 'event'"),
        ("t_s,event\n1,closed\n", "no rows of open fists", "after line 1"),
        ("when\n1\n", "no column of times; found: 'when'", "line 1"),
        ("t_s\nnow\n", "is text", "line 2"),
        ("t_s\n", "no rows", "after line 1"),
        ("t_s,n\n,1\n", "without a time", "line 2"),
    ],
)
def test_grasp_files_that_cannot_be_used_say_where(write, text, what, where):
    with pytest.raises(UndecodableFile, match=what) as caught:
        decode_grasps(write(text))
    assert where in caught.value.where


def test_a_wide_export_gives_fractions_that_add_up(recordings):
    decoded = decode_strivepd(recordings / "tremor/strivepd_wide.csv")
    (minutes,) = decoded.outcomes
    assert minutes.fractions.shape == (12, 6)
    np.testing.assert_allclose(minutes.fractions.sum(axis=1), 1.0, atol=0.01)
    assert minutes.fractions[0, TREMOR_CLASSES.index("mild")] == 0.173913
    assert any("rounded" in text for text in decoded.reports[0].flagged)


def test_in_a_long_export_all_is_no_severity_and_identity_is_named(recordings):
    decoded = decode_strivepd(recordings / "tremor/strivepd_long.csv")
    (minutes,) = decoded.outcomes
    assert minutes.start_unix_s[0] == 1668225180.0
    np.testing.assert_allclose(minutes.any_tremor[-2:], [10.434783 / 60, 5 / 60])
    assert np.isnan(minutes.fractions[-1, TREMOR_CLASSES.index("mild")])
    np.testing.assert_array_equal(minutes.fractions[0, 2:], 0.0)
    (removed,) = decoded.reports[0].removed
    assert removed.startswith("6 other columns: ")
    assert "called like an identifier" in removed


def test_a_long_export_is_gathered_by_minute(write):
    rows = ["mild,6", "moderate,3", "none,51", "slight,0", "strong,0", "unknown,0", "all,9"]
    text = "time,severity,duration\n" + "".join(f"2022-11-12T03:53:00Z,{row}\n" for row in rows)
    (minutes,) = decode_strivepd(write(text)).outcomes
    np.testing.assert_allclose(minutes.fractions, [[0, 0.85, 0, 0.1, 0.05, 0]])
    np.testing.assert_allclose(minutes.any_tremor, [0.15])


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("a,b\n1,2\n", "no column of times"),
        ("time,b\n1,2\n", "no layout"),
        ("time,severity,duration\nsoon,mild,1\n", "is no time"),
        ("time,mild,moderate,none,slight,strong,unknown\n1588184000,2,0,0,0,0,0\n", "outside 0 to 1"),
        ("time,mild,moderate,none,slight,strong,unknown\n", "no minute"),
        ("minute_start,class\n2026-01-05T10:00:00Z,heavy\n", "'heavy' is no class"),
        ("minute_start,class\n60,mild\n", "is no date"),
        ("minute_start,class\n1900-01-05T10:00:00Z,mild\n", "before any watch"),
        ("minute_start,class\n,mild\n", "has no time"),
        ("time,severity,duration\n2022-11-12T03:53:00Z,mild,90\n", "more seconds than it has"),
        ("time,severity,duration\n2022-11-12T03:53:00Z,mild,9\n2022-11-12T03:53:00Z,mild,8\n", "differently"),
    ],
)
def test_tremor_files_that_cannot_be_used_say_why(write, text, what):
    with pytest.raises(UndecodableFile, match=what):
        decode_strivepd(write(text))


@pytest.mark.parametrize(
    "stamp", ["1668225180", "1668225180000", "1668225180000000000", "2022-11-12T03:53:00+00:00", "2022-11-11T19:53:00-08:00"]
)
def test_times_are_read_in_any_of_their_spellings(write, stamp):
    (minutes,) = decode_strivepd(write(f"time,severity,duration\n{stamp},mild,1\n")).outcomes
    assert minutes.start_unix_s.tolist() == [1668225180.0]


@pytest.mark.parametrize(
    "text",
    [
        "minute_start,class\n2026-01-05T10:00:00Z,mild\n2026-01-05T10:01:00Z,none\n",
        "start_utc;Class\n2026-01-05 10:01:00Z;NONE\n2026-01-05 10:00:00Z;Mild\n",
        "Time,tremor_class,note\n1767607200,mild,x\n1767607260,none,y\n",
    ],
)
def test_a_table_of_one_class_per_minute_gives_whole_minutes_in_time_order(write, text):
    path = write(text)
    assert sniff(path) == "tremor"
    (minutes,) = decode(path).outcomes
    assert minutes.start_unix_s.tolist() == [1767607200.0, 1767607260.0]
    assert [TREMOR_CLASSES[i] for i in minutes.fractions.argmax(axis=1)] == ["mild", "none"]
    assert minutes.duration_s.tolist() == [60.0, 60.0]
    assert minutes.any_tremor.tolist() == [1.0, 0.0]


def test_a_time_without_a_zone_is_read_as_utc_and_said(write):
    decoded = decode(write("minute_start,class\n2026-01-05 10:00:00,mild\n"))
    assert decoded.outcomes[0].start_unix_s.tolist() == [1767607200.0]
    assert any("read as UTC" in text for text in decoded.reports[0].flagged)


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("t_s\n1\n2\n", "grasp"),
        ("t_us,hand\n1,L\n", "grasp"),
        ("open_fist_s,confidence\n1,0.9\n", "grasp"),
        ("time,level\n1,2\n", "csv"),
        ("t_s,beta\n2,1\n", "csv"),
        ("t_s,hand,beta,amplitude_ma\n2,L,1,1\n", "csv"),
        ("t_s,beta,amplitude_ma\n2,1,1\n", "csv"),
        ("t_s,lfp [uV]\n0.004,1\n", "csv"),
        ("time,severity,duration\n1668225180,mild,1\n", "tremor"),
        ("class,grade\n1,2\n", "csv"),
        ("", None),
    ],
)
def test_tables_are_told_apart_by_their_columns(write, text, kind):
    if kind is None:
        with pytest.raises(UndecodableFile, match="empty"):
            sniff(write(text))
    else:
        assert sniff(write(text)) == kind


@pytest.mark.parametrize("cell", ["=1+1", "+cmd|' /C calc'!A0", "-1+1", "@SUM(A1)"])
def test_a_formula_for_a_number_is_refused_with_its_line_and_elsewhere_it_is_not_kept(write, cell):
    with pytest.raises(UndecodableFile) as caught:
        decode(write(f't_s\n1\n"{cell}"\n'))
    assert "line 3" in caught.value.where
    decoded = decode(write(f't_s,hand,note\n1,L,"{cell}"\n2,L,x\n'))
    assert cell not in repr(decoded)
    assert decoded.outcomes[0].open_fist_s.tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    "encode", [lambda t: b"\xef\xbb\xbf" + t.encode(), lambda t: t.encode("utf-16"), lambda t: t.replace("\n", "\r\n").encode()]
)
@pytest.mark.parametrize(
    ("text", "kind"), [("minute_start,class\n2026-01-05T10:00:00Z,mild\n", "tremor"), ("t_s,hand\n1.5,L\n2,L\n", "grasp")]
)
def test_marks_encodings_and_a_wrong_extension_do_not_matter(tmp_path, encode, text, kind):
    path = tmp_path / "session.json"
    path.write_bytes(encode(text))
    assert sniff(path) == kind
    decoded = decode(path)
    assert len(decoded.outcomes) == 1


@given(
    header=st.sampled_from(
        ["minute_start,class", "time,severity,duration", "time,unknown,none,slight,mild,moderate,strong", "t_s,hand", "t_us", "t_s,lfp_uV"]
    ),
    body=st.one_of(st.binary(max_size=200), st.text(alphabet="0123456789.,-+eEmildLRTZ:;= \n\tnaINF", max_size=200).map(str.encode)),
)
def test_whatever_follows_a_header_gives_content_or_a_clear_error(tmp_path_factory, header, body):
    path = tmp_path_factory.mktemp("t") / "x.csv"
    path.write_bytes(header.encode() + b"\n" + body)
    found, said = (), ""
    try:
        decoded = decode(path)
        found = (*decoded.recordings, *decoded.outcomes)
    except UndecodableFile as error:
        said = error.what and error.where and error.hint
    assert found or said


@pytest.mark.parametrize("cell", ["nan", "INF", "1e999", ""])
def test_a_share_without_a_number_leaves_the_minute_undivided(write, cell):
    decoded = decode(write(f"time,unknown,none,slight,mild,moderate,strong\n1588184000,0,1,0,{cell},0,0\n"))
    assert np.isnan(decoded.outcomes[0].fractions[0, TREMOR_CLASSES.index("mild")])
    assert any("not known" in text for text in decoded.reports[0].flagged)


def test_frames_of_a_hand_tracker_are_no_open_fists(write):
    frames = "t_s,hand,grab_strength\n" + "".join(f"{k / 60:.4f},L,0.5\n" for k in range(200))
    with pytest.raises(UndecodableFile, match="200 times that follow each other every 17 ms: frames of a hand tracker"):
        decode_grasps(write(frames))


def test_a_gap_of_lost_tracking_is_flagged_as_one_interval(write):
    fists = "t_s\n" + "".join(f"{k / 2 + 6 * (k >= 8)}\n" for k in range(1, 20))
    assert decode_grasps(write(fists)).reports[0].flagged == ["1 interval outside 0.08 to 3 s: kept, look at it"]


def test_minutes_of_a_night_with_a_changed_clock_name_it_and_a_stored_export_loses_no_column(write, tmp_path):
    head = "time,unknown,none,slight,mild,moderate,strong\n"
    minutes = [f"2026-10-25T02:{m:02d}:00,0,0.5,0.25,0.25,0,0\n" for m in (58, 59, 0, 1, 58)]
    path = write(head + "".join(minutes))
    flagged = decode_strivepd(path).reports[0].flagged
    assert any("1 minute begins before" in text and "in which the clocks were changed" in text for text in flagged)
    clean = tmp_path / "clean.csv"
    redact(path, clean, "tremor", b"a key of the clinic's own")
    assert decode_strivepd(clean).reports[0].removed == []
