from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.ingest.formats import DecodeOptions, UndecodableFile, decode, sniff

HEADER = "t_s,beta,amplitude_fraction\n"


@pytest.fixture
def write(tmp_path):
    def make(content, name="table.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return make


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
    assert decoded.reports[0].repaired == ["2 missing rows filled in as gaps"]


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
        (HEADER, "no rows", "after line 1"),
        ("", "empty", "file"),
        ("\n\n", "empty", "line 1"),
        (HEADER + "2,1,5,1\n", "4 cells where the header has 3", "line 2"),
        ("t_s;beta;a\n2;1.234,5;1\n", "decimal points and commas", "line 2"),
        ("t_s,beta,Beta,a\n2,1,1,1\n", "two columns both give beta", "line 1"),
        ("t (h),beta,a\n2,1,1\n", "unknown unit 'h'", "column"),
        (HEADER + "2,1,1\n9e9,1,1\n", "span", "column t_s"),
        (HEADER + "2," + "9" * 200_000 + ",1\n", "not readable as a table", "line 2"),
        (HEADER + "2" * 1_100_000, "a line of more than", "line 2"),
    ],
)
def test_a_table_that_cannot_be_used_says_what_where_and_how_to_mend_it(write, text, what, where):
    with pytest.raises(UndecodableFile, match=what) as caught:
        decode(write(text))
    assert where in caught.value.where
    assert caught.value.mend


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


CELLS = st.one_of(st.none(), st.floats(0, 1e6, allow_subnormal=False, width=32))


@given(
    rows=st.lists(st.tuples(CELLS, CELLS), min_size=1, max_size=30),
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
    recordings, said = (), ""
    try:
        recordings = decode(path).recordings
    except UndecodableFile as error:
        said = error.what and error.where and error.mend
    assert recordings or said
