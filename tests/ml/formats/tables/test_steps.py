from __future__ import annotations

import pickle

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats import DecodeOptions, UndecodableFile, decode, sniff
from ml.formats.tables.cells.fills import FILLS
from ml.formats.tables.cells.numbers import unit_name

HEADER = "t_s,beta,amplitude_fraction\n"


def trace(decoded, stream):
    return next(t for t in decoded.recordings[0].traces if t.stream == stream)


def test_a_plain_table_gives_beta_and_amplitude_on_the_rows_it_names(write):
    decoded = decode(write(HEADER + "-2,1.5,0.5\n0,1.25,0.5\n2,1,1\n4,0.5,0\n"))
    beta, amplitude = trace(decoded, "beta"), trace(decoded, "amplitude")
    assert (beta.t_end_first_s, beta.dt_s, beta.source) == (-2.0, 2.0, "table")
    np.testing.assert_array_equal(beta.values, [1.5, 1.25, 1.0, 0.5])
    np.testing.assert_array_equal(amplitude.values, [0.5, 0.5, 1.0, 0.0])
    assert amplitude.unit == "fraction"
    assert decoded.recordings[0].duration_s == 4.0
    assert "2 before the session, 2 of the session" in decoded.reports[0].understood[0]


@pytest.mark.parametrize(
    "text",
    [
        "\ufeffT (s) , Beta [uV] ,Amplitude Fraction\n2,1.5,0.5\n4,1.0,1\n",
        "t_s;beta [uV];amplitude_fraction\n2;1,5;0,5\n4;1,0;1\n",
        "t_s\tbeta (uV)\tamplitude-fraction\n2\t1.5\t0.5\n4\t1.0\t1\n",
        "sep=;\r\ntime;P_beta (uV);fraction\r\n2;1.5;0.5\r\n\r\n4;1.0;1;\r\n",
        't_s,beta (uV),amplitude_fraction\n2,"1,5","0,5"\n4,1,1\n',
        "t (ms),beta (uV),amplitude_fraction\n2000,1.5,0.5\n4000,1,1\n",
    ],
)
def test_names_marks_and_units_are_forgiven(write, text):
    decoded = decode(write(text))
    np.testing.assert_array_equal(trace(decoded, "beta").values, [1.5, 1.0])
    np.testing.assert_array_equal(trace(decoded, "amplitude").values, [0.5, 1.0])
    assert trace(decoded, "beta").unit == "uV"


def test_utf16_from_a_spreadsheet_is_read(write):
    decoded = decode(write((HEADER.replace(",", "\t") + "2\t1\t1\n").encode("utf-16")))
    assert trace(decoded, "beta").values.tolist() == [1.0]


def test_milliamperes_are_kept_as_milliamperes(write):
    amplitude = trace(decode(write("t_s,beta,Amplitude (mA)\n2,1,2.4\n")), "amplitude")
    assert (amplitude.unit, amplitude.channel) == ("mA", "amplitude_ma")
    assert amplitude.values[0] == np.float32(2.4)


@pytest.mark.parametrize(
    ("header", "cell", "milliamps"),
    [
        ("amplitude_ma", "2.4", 2.4),
        ("amplitude_ma [uA]", "2400", 2.4),
        ("amplitude (\u00b5A)", "2400", 2.4),
        ("amplitude (\u03bcA)", "25400", 25.4),
        ("amplitude_ma (A)", "0.0024", 2.4),
        ("Amplitude [A]", "0.0254", 25.4),
    ],
)
def test_amplitudes_are_converted_to_milliamperes_by_the_unit_of_their_header(write, header, cell, milliamps):
    amplitude = trace(decode(write(f"t_s,beta,{header}\n2,1,{cell}\n")), "amplitude")
    assert amplitude.unit == "mA"
    assert amplitude.values[0] == pytest.approx(milliamps, rel=1e-6)


@pytest.mark.parametrize("unit", ["[%]", "(percent)", "(%)"])
def test_percent_becomes_a_fraction(write, unit):
    amplitude = trace(decode(write(f"t_s,beta,amplitude_fraction {unit}\n2,1,50\n4,1,100\n")), "amplitude")
    assert amplitude.unit == "fraction"
    np.testing.assert_array_equal(amplitude.values, np.array([0.5, 1.0], dtype=np.float32))


def test_an_amplitude_unit_in_parquet_metadata_is_converted_too(tmp_path):
    schema = pa.schema([("t_s", pa.float64()), ("beta", pa.float64()), pa.field("amplitude", pa.float64(), metadata={"unit": "uA"})])
    path = tmp_path / "t.parquet"
    pq.write_table(pa.table({"t_s": [2.0], "beta": [1.0], "amplitude": [1500.0]}, schema=schema), path)
    assert trace(decode(path), "amplitude").values.tolist() == [1.5]


def test_an_impossible_beta_is_a_gap_with_its_line_and_a_negative_one_is_kept_and_flagged_once(write):
    decoded = decode(write(HEADER + "2,-0.5,1\n4,1e10,1\n6,-2e9,1\n8,-1,1\n"))
    beta = trace(decoded, "beta")
    assert beta.valid.tolist() == [True, False, False, True]
    assert beta.values[[0, 3]].tolist() == [-0.5, -1.0]
    assert [text for text in decoded.reports[0].flagged if "line 3, 4" in text]
    assert len([text for text in decoded.reports[0].flagged if "2 rows have a negative beta" in text]) == 1


def test_of_two_amplitudes_the_milliamperes_are_kept_and_a_contradiction_is_flagged(write):
    header = "t_s,beta,amplitude_fraction,amplitude_ma\n"
    agreed = decode(write(header + "2,1,0.5,1.5\n4,1,1,3.06\n6,1,0.01,0.5\n"))
    assert [t.channel for t in agreed.recordings[0].traces] == ["table", "amplitude_ma"]
    assert any("amplitude_ma is given too" in text for text in agreed.reports[0].ignored)
    assert agreed.reports[0].flagged == []
    contradicted = decode(write(header + "2,1,0.5,1.5\n4,1,1,3.2\n"))
    assert any("disagree" in text and "3 to 3.2 mA" in text for text in contradicted.reports[0].flagged)


@pytest.mark.parametrize(
    ("written", "name"),
    [
        ("\u00b5V", "uV"),
        ("\u03bcV", "uV"),
        (" uV ", "uV"),
        ("UV", "uV"),
        ("\u00b5V\u00b2", "uV2"),
        ("uV^2/Hz", "uV2/Hz"),
        ("device  units", "device units"),
        ("furlong", "furlong"),
    ],
)
def test_one_unit_has_one_name(written, name):
    assert unit_name(written) == name


def test_both_micro_signs_in_header_or_settings_give_the_same_unit_and_fingerprint(write):
    header = "t_s,beta [{}],amplitude_fraction\n2,1,1\n"
    plain = decode(write(header.format("uV"))).recordings[0]
    for sign in ("\u00b5V", "\u03bcV"):
        assert decode(write(header.format(sign))).recordings[0].fingerprint == plain.fingerprint
        stated = decode(write(HEADER + "2,1,1\n"), options=DecodeOptions(table_beta_unit=sign)).recordings[0]
        assert stated.fingerprint == plain.fingerprint


def test_a_text_in_brackets_that_is_no_unit_is_not_taken_for_one(write):
    decoded = decode(write("t_s,beta (Jane Doe),amplitude_fraction\n2,1,1\n"))
    assert trace(decoded, "beta").unit == "unstated"
    assert any("no unit known here" in text for text in decoded.reports[0].repaired)
    assert "Jane" not in repr(decoded)


@pytest.mark.parametrize(
    "text",
    [
        "t_s,beta,Jane Doe\n2,1,1\n",
        "t_s,beta [Jane Doe],amplitude_fraction\n2,Jane Doe,1\n",
        "t_s,beta,Beta (Jane Doe),a\n2,1,1,1\n",
        "t_s,beta,amplitude (Jane Doe)\n2,1,1\n",
        "t_s (Jane Doe),beta,a\n2,1,1\n",
    ],
)
def test_the_stored_problem_does_not_repeat_the_files_words_and_the_told_one_does(write, text):
    with pytest.raises(UndecodableFile) as caught:
        decode(write(text))
    assert "Jane" in caught.value.for_sender.what + caught.value.for_sender.where
    assert "Jane" not in repr(caught.value.stored)
    assert pickle.loads(pickle.dumps(caught.value)).stored == caught.value.stored


@pytest.mark.parametrize("cell", ["", "NaN", "nan", "INF", "-inf", "n/a", "1e999"])
def test_cells_without_a_number_become_gaps_and_are_said(write, cell):
    decoded = decode(write(HEADER + f"2,{cell},1\n4,2,1\n"))
    beta = trace(decoded, "beta")
    assert beta.valid.tolist() == [False, True]
    assert np.isnan(beta.values[0])
    assert any("1 rows without a number" in text for text in decoded.reports[0].flagged)


def test_missing_rows_become_gaps_and_are_said(write):
    decoded = decode(write(HEADER + "2,1,1\n8,2,1\n"))
    assert trace(decoded, "beta").valid.tolist() == [True, False, False, True]
    assert decoded.reports[0].flagged == ["2 rows missing: gaps"]
    assert decoded.reports[0].repaired == [], "what is lost was not repaired"


def test_an_amplitude_above_the_cdbs_amplitude_is_kept_and_flagged(write):
    decoded = decode(write(HEADER + "2,1,1.2\n"))
    assert trace(decoded, "amplitude").values[0] == np.float32(1.2)
    assert any("fraction > 1" in text for text in decoded.reports[0].flagged)


def test_columns_of_no_use_are_named(write):
    decoded = decode(write("t_s,beta,amplitude_fraction,mood\n2,1,1,fine\n"))
    assert "mood" in decoded.reports[0].ignored[0]


@pytest.mark.parametrize(
    ("text", "what", "where"),
    [
        ("t_s,beta\n2,1\n", "missing column amplitude_fraction.*found: 't_s', 'beta'", "line 1"),
        ("time stamp,beta,a\n2,1,1\n", "missing column t_s", "line 1"),
        (HEADER + "4,1,1\n2,1,1\n", "2 s comes after 4 s", "line 3, column t_s"),
        (HEADER + "2,1,1\n2,1,1\n", "2 s appears twice", "line 3, column t_s"),
        (HEADER + "2,1,1\n5,1,1\n", "3 s between two rows where the period is 2 s", "line 3, column t_s"),
        (HEADER + "1,1,1\n3,1,1\n", "1 s is no multiple of the period", "line 2, column t_s"),
        (HEADER + "2,high,1\n", "'high' is text", "line 2, column beta"),
        (HEADER + "2,1,1\n4,=1+1,1\n", "'=1\\+1' is text", "line 3, column beta"),
        (HEADER + "2,1,@SUM(A1)\n", "is text", "line 2, column amplitude_fraction"),
        (HEADER + ",1,1\n", "no time", "line 2, column t_s"),
        (HEADER + "-2,1,1\n0,1,1\n", "no row with t_s > 0", "column t_s"),
        (HEADER + "2,1,-0.1\n", "negative amplitude -0.1", "line 2, column amplitude_fraction"),
        ("t_s,beta,amplitude_ma [V]\n2,1,1\n", "unknown unit 'V'", "column amplitude_ma [V]"),
        ("t_s,beta,amplitude (W)\n2,1,1\n", "unknown unit 'W'", "column amplitude (W)"),
        ("t_s,beta,amplitude_fraction (mA)\n2,1,1\n", "unknown unit 'mA'", "column amplitude_fraction"),
        ("t_s,beta,amplitude_ma\n2,1,1\n4,1,25.6\n", "amplitude 25.6 mA, more than the 25.5 mA", "line 3, column amplitude_ma"),
        (HEADER + "2,1,10.1\n", "amplitude fraction 10.1", "line 2, column amplitude_fraction"),
        (HEADER, "no rows", "after line 1"),
        ("", "empty", "file"),
        ("\n\n", "empty", "line 1"),
        (HEADER + "2,1,5,1\n", "4 cells where the header has 3", "line 2"),
        ("t_s;beta;a\n2;1.234,5;1\n", "decimal points and commas", "line 2"),
        ("t_s,beta,Beta,a\n2,1,1,1\n", "two columns both give beta", "line 1"),
        ("t (h),beta,a\n2,1,1\n", "unknown unit 'h'", "column"),
        (HEADER + "2,1,1\n9e9,1,1\n", "more than a week", "column t_s"),
        (HEADER + "2," + "9" * 200_000 + ",1\n", "not readable as a table", "line 2"),
        (HEADER + "2" * 1_100_000, "a line of more than", "line 2"),
    ],
)
def test_a_table_that_cannot_be_used_says_what_where_and_how_to_mend_it(write, text, what, where):
    with pytest.raises(UndecodableFile, match=what) as caught:
        decode(write(text))
    assert where in caught.value.where
    assert caught.value.hint


def test_a_table_is_known_by_its_content_not_its_extension(write, tmp_path):
    assert sniff(write(HEADER, "table.json")) == "csv"
    path = tmp_path / "table.csv"
    pq.write_table(pa.table({"t_s": [2.0], "beta": [1.0], "amplitude_ma": [2.0]}), path)
    assert sniff(path) == "parquet"
    assert trace(decode(path), "amplitude").values.tolist() == [2.0]


@pytest.mark.parametrize("content", [b"\x89PNG\r\n\x1a\n\x00\x00", b'[{"RecordInfo": {}}]', b""])
def test_what_is_no_table_is_refused(write, content):
    with pytest.raises(UndecodableFile):
        decode(write(content))


def test_parquet_nulls_are_gaps_and_a_field_may_state_its_unit(tmp_path):
    schema = pa.schema([("t_s", pa.int32()), pa.field("beta", pa.float64(), metadata={"unit": "uV"}), ("amplitude_fraction", pa.float32())])
    path = tmp_path / "t.parquet"
    pq.write_table(pa.table({"t_s": [2, 4], "beta": [1.0, None], "amplitude_fraction": [1.0, float("inf")]}, schema=schema), path)
    decoded = decode(path)
    assert trace(decoded, "beta").unit == "uV"
    assert trace(decoded, "beta").valid.tolist() == [True, False]
    assert trace(decoded, "amplitude").valid.tolist() == [True, False]


def test_parquet_with_text_or_damage_is_refused(tmp_path):
    path = tmp_path / "t.parquet"
    pq.write_table(pa.table({"t_s": ["2"], "beta": [1.0], "amplitude_fraction": [1.0]}), path)
    with pytest.raises(UndecodableFile, match="string, not numbers"):
        decode(path)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(UndecodableFile, match="damaged"):
        decode(path)


def test_too_many_rows_are_refused_before_they_fill_memory(write, tmp_path):
    options = DecodeOptions(max_table_rows=3)
    with pytest.raises(UndecodableFile, match="more than 3 rows"):
        decode(write(HEADER + "".join(f"{2 * k},1,1\n" for k in range(1, 6))), options=options)
    path = tmp_path / "t.parquet"
    pq.write_table(pa.table({"t_s": np.arange(1.0, 9.0) * 2, "beta": np.ones(8), "a": np.ones(8)}), path)
    with pytest.raises(UndecodableFile, match="more than 3 rows"):
        decode(path, options=options)


def test_the_same_table_has_the_same_fingerprint_and_another_does_not(write):
    first = decode(write(HEADER + "2,1,1\n")).recordings[0].fingerprint
    assert first == decode(write("t_s;beta;amplitude_fraction\n2;1,0;1\n", "b.csv")).recordings[0].fingerprint
    assert first != decode(write(HEADER + "2,1.5,1\n")).recordings[0].fingerprint


CELLS = st.one_of(st.none(), st.floats(0, 1e6, allow_subnormal=False, width=32).filter(lambda x: x not in FILLS))
CURRENTS = st.one_of(st.none(), st.floats(0, 25.0, allow_subnormal=False, width=32))


@given(
    rows=st.lists(st.tuples(CELLS, CURRENTS), min_size=1, max_size=30),
    before=st.integers(0, 12),
    style=st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")]),
    newline=st.sampled_from(["\n", "\r\n"]),
)
def test_any_table_written_in_any_style_comes_back(tmp_path_factory, rows, before, style, newline):
    delimiter, decimal = style
    first = 2.0 * (1 - min(before, len(rows) - 1))

    def cell(value):
        return "" if value is None else repr(value).replace(".", decimal)

    lines = [delimiter.join(("t_s", "beta", "amplitude_ma"))]
    lines += [delimiter.join((cell(first + 2.0 * k), cell(b), cell(a))) for k, (b, a) in enumerate(rows)]
    path = tmp_path_factory.mktemp("t") / "t.csv"
    path.write_bytes(newline.join(lines).encode())
    decoded = decode(path)
    for stream, column in (("beta", 0), ("amplitude", 1)):
        expected = np.array([np.nan if row[column] is None else row[column] for row in rows], dtype=np.float32)
        np.testing.assert_array_equal(trace(decoded, stream).values, expected)
    assert trace(decoded, "beta").t_end_first_s == first


@given(content=st.one_of(st.binary(max_size=300), st.text(alphabet="t_s,beta;\t\n-019.eE=\"'NaN", max_size=200).map(str.encode)))
def test_no_bytes_whatever_raise_anything_but_a_clear_error(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("t") / "x.csv"
    path.write_bytes(content)
    found, said = (), ""
    try:
        decoded = decode(path)
        found = (*decoded.recordings, *decoded.outcomes)
    except UndecodableFile as error:
        said = error.what and error.where and error.hint
    assert found or said


@pytest.mark.parametrize(
    "text",
    [
        "t_s;beta;amplitude_ma\n2;956;1\n4;1.054;1\n6;1.100;1\n",
        "t_s,beta,amplitude_ma\n2,956,1\n4,1.054,1\n",
        "t_s;beta;amplitude (uA)\n2;0.5;1.500\n4;0.6;1.500\n",
        't_s,beta,amplitude_ma\n2,"1,234",1\n4,"1,300",1\n',
        "t_s;beta;amplitude_ma\n2;956;1\n4;1,054;1\n",
        "t_s;beta;amplitude_ma\n2;1'234;1\n",
        "t_s;beta;amplitude_ma\n2;1 234;1\n",
    ],
)
def test_a_number_that_may_have_a_thousands_separator_is_refused(write, text):
    with pytest.raises(UndecodableFile, match=r"line [23], column"):
        decode(write(text))


@pytest.mark.parametrize(
    ("text", "beta"),
    [
        ("t_s,beta,amplitude_ma\n2,1.266,1\n4,1.054,1\n", [1.266, 1.054]),
        ("t_s;beta;amplitude_ma\n2;0.266;1\n4;1.054;1\n", [0.266, 1.054]),
        ("t_s;beta;amplitude_ma\n2;1.2;1\n4;1.054;1\n", [1.2, 1.054]),
        ("t_s;beta;amplitude_ma\n2;1,266;1\n4;1,054;1\n", [1.266, 1.054]),
    ],
)
def test_a_number_that_is_decimal_for_sure_is_read(write, text, beta):
    np.testing.assert_allclose(trace(decode(write(text)), "beta").values, beta, rtol=1e-6)


def rows(times):
    return HEADER + "".join(f"{t:g},1.5,0.5\n" for t in times)


@pytest.mark.parametrize(
    ("times", "mend"),
    [
        (np.arange(32_402, 32_522, 2), "seconds of the day"),
        (np.arange(2000, 122_000, 2000), "t_ms"),
        (np.arange(2, 100_000, 2), "would last"),
    ],
)
def test_times_of_another_clock_or_unit_are_refused(write, times, mend):
    with pytest.raises(UndecodableFile, match=mend):
        decode(write(rows(times)))
