from __future__ import annotations

import numpy as np
import pytest

from app.ingest.formats import UndecodableFile
from app.ingest.formats.grasps import decode_grasps
from app.ingest.formats.strivepd import CLASSES, decode_strivepd
from ml.qoc import grasp_frequency


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
    (hand,) = decode_grasps(write(text)).hands
    assert hand.hand is None
    assert grasp_frequency(hand.open_fist_s) == pytest.approx(2.0)


def test_a_column_of_hands_gives_one_test_per_hand(write):
    decoded = decode_grasps(write("t_s,hand\n1,L\n1.1,right\n2,left\n2.6,R\n"))
    assert {h.hand: h.open_fist_s.tolist() for h in decoded.hands} == {"left": [1.0, 2.0], "right": [1.1, 2.6]}


def test_implausible_intervals_are_flagged_and_kept(write):
    decoded = decode_grasps(write("t_s\n0\n0.05\n1\n5\n"))
    assert decoded.hands[0].implausible.tolist() == [True, False, True]
    assert decoded.hands[0].open_fist_s.size == 4
    assert "2 intervals" in decoded.report.flagged[0]


def test_a_single_open_fist_is_kept_and_said_to_be_too_few(write):
    assert any("fewer than two" in text for text in decode_grasps(write("t_s\n1\n")).report.flagged)


@pytest.mark.parametrize(
    ("text", "what", "where"),
    [
        ("t_s\n1\n1\n", "must increase", "line 3"),
        ("t_s,n\n1,2\n\n1,2,3\n", "3 cells where the header has 2", "line 4"),
        ("t_s,hand\n1,B\n", "unknown hand", "line 2"),
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
    minutes = decoded.minutes
    assert minutes.fractions.shape == (12, 6)
    np.testing.assert_allclose(minutes.fractions.sum(axis=1), 1.0, atol=0.01)
    assert minutes.fractions[0, CLASSES.index("mild")] == 0.173913
    assert any("rounded" in text for text in decoded.report.flagged)


def test_in_a_long_export_all_is_no_severity_and_identity_is_named(recordings):
    decoded = decode_strivepd(recordings / "tremor/strivepd_long.csv")
    minutes = decoded.minutes
    assert minutes.start_unix_s[0] == 1668225180.0
    np.testing.assert_allclose(minutes.any_tremor[-2:], [10.434783 / 60, 5 / 60])
    assert np.isnan(minutes.fractions[-1, CLASSES.index("mild")])
    np.testing.assert_array_equal(minutes.fractions[0, 2:], 0.0)
    assert decoded.report.removed == ["column patient_id", "column device_id"]


def test_a_long_export_is_gathered_by_minute(write):
    rows = ["mild,6", "moderate,3", "none,51", "slight,0", "strong,0", "unknown,0", "all,9"]
    text = "time,severity,duration\n" + "".join(f"2022-11-12T03:53:00Z,{row}\n" for row in rows)
    minutes = decode_strivepd(write(text)).minutes
    np.testing.assert_allclose(minutes.fractions, [[0, 0.85, 0, 0.1, 0.05, 0]])
    np.testing.assert_allclose(minutes.any_tremor, [0.15])


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("a,b\n1,2\n", "missing column time"),
        ("time,b\n1,2\n", "neither layout"),
        ("time,severity,duration\nsoon,mild,1\n", "is no time"),
        ("time,mild,moderate,none,slight,strong,unknown\n1588184000,2,0,0,0,0,0\n", "outside 0 to 1"),
    ],
)
def test_tremor_files_that_cannot_be_used_say_why(write, text, what):
    with pytest.raises(UndecodableFile, match=what):
        decode_strivepd(write(text))


@pytest.mark.parametrize(
    "stamp", ["1668225180", "1668225180000", "1668225180000000000", "2022-11-12T03:53:00+00:00", "2022-11-11T19:53:00-08:00"]
)
def test_times_are_read_in_any_of_their_spellings(write, stamp):
    minutes = decode_strivepd(write(f"time,severity,duration\n{stamp},mild,1\n")).minutes
    assert minutes.start_unix_s.tolist() == [1668225180.0]
