from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats import DecodeOptions, UndecodableFile, decode, redact, sniff
from ml.formats.tables.redact import redact_table

KEY = b"a key of the clinic's own"


@pytest.mark.parametrize(
    "text",
    [
        "T (s) , Beta [\u00b5V] ,Jane Doe MRN 4711,Amplitude Fraction\n-2,1.5,1950-03-01,0.1\n2,1e10,Jane Doe,1.2\n\n\n4,,x,\n",
        "sep=;\nt_s;Jane Doe;beta (Jane Doe 4711);amplitude_ma [uA];amplitude_fraction [%]\n2;1950;-1,5;2400;80\n\n6;;1e-7;0,1;0\n",
        't (ms)\tbeta\tamplitude (A)\tJane Doe\n2000\t0.1\t0.0024\t"Jane\nDoe"\n4000\t3\t0.0255\t\n6000\t3e9\t0\t\n',
    ],
)
def test_a_redacted_table_holds_the_known_columns_alone_and_decodes_to_the_same_recording(tmp_path, same_recording, text):
    source, target, again = tmp_path / "s.csv", tmp_path / "t.csv", tmp_path / "u.csv"
    source.write_text(text, encoding="utf-8")
    done = redact_table(source, target, "csv", DecodeOptions())
    redact_table(source, again, "csv", DecodeOptions())
    assert target.read_bytes() == again.read_bytes()
    assert [text.split(":")[0] for text in done.removed] == ["1 other column"]
    assert not any(word in target.read_text() for word in ("Jane", "Doe", "4711", "1950"))
    first, second = decode(source), decode(target, name="s.csv")
    assert same_recording(first.recordings[0], second.recordings[0])
    assert first.reports[0].flagged == second.reports[0].flagged
    assert first.reports[0].repaired == [*done.repaired, *(r for r in second.reports[0].repaired if r not in done.repaired)]
    assert "Jane" not in repr((second, done))


def test_a_redacted_parquet_table_has_no_foreign_column_and_no_metadata(tmp_path, same_recording):
    fields = [
        ("t_s", pa.int32()),
        pa.field("beta", pa.float32(), metadata={"unit": "\u00b5V", "by": "Jane"}),
        ("a", pa.float64()),
        ("Jane", pa.string()),
        ("MRN", pa.int64()),
    ]
    columns = {"t_s": [2, 4], "beta": [0.1, None], "a": [0.3, float("inf")], "Jane": ["Doe", "Doe"], "MRN": [4711, 4711]}
    source, target, again = tmp_path / "s.parquet", tmp_path / "t.parquet", tmp_path / "u.parquet"
    pq.write_table(pa.table(columns, schema=pa.schema(fields, metadata={"patient": "Jane Doe"})), source)
    assert [t.split(":")[0] for t in redact_table(source, target, "parquet", DecodeOptions()).removed] == ["2 other columns"]
    redact_table(source, again, "parquet", DecodeOptions())
    assert target.read_bytes() == again.read_bytes()
    assert pq.read_schema(target).names == ["t_s", "beta [uV]", "amplitude_fraction"]
    assert pq.read_schema(target).metadata is None
    assert not any(word in target.read_bytes() for word in (b"Jane", b"Doe", b"MRN"))
    assert same_recording(decode(source).recordings[0], decode(target).recordings[0])


def test_a_table_that_cannot_be_decoded_is_not_written(tmp_path):
    source, target = tmp_path / "s.csv", tmp_path / "t.csv"
    source.write_text("t_s,beta,amplitude_fraction\n2,1,1\n5,1,1\n")
    with pytest.raises(UndecodableFile, match="3 s between two rows"):
        redact_table(source, target, "csv", DecodeOptions())
    assert not target.exists()


TREMOR = [
    "time,mild,moderate,none,slight,strong,unknown,Jane Doe\n1588184000.0,0.17,0.0,0.57,0.09,0.0,0.17,MRN 4711\n",
    "time,severity,duration,patient_id,device_id\n2022-11-12T03:53:00Z,all,10.434783,Jane,NPC1\n2022-11-12T03:54:00Z,mild,6,Doe,NPC1\n",
    "minute_start;class;name\n2026-01-05 10:00;mild;Jane\n2026-01-05 10:01;Unknown;Doe\n",
]


@pytest.mark.parametrize("text", TREMOR)
def test_redacted_tremor_is_the_same_minutes_without_anything_else(tmp_path, text):
    source, target, again = (tmp_path / name for name in ("s.csv", "t.csv", "u.csv"))
    source.write_text(text)
    assert sniff(source) == "tremor"
    done = redact(source, target, "tremor", KEY)
    redact(target, again, "tremor", KEY)
    assert again.read_bytes() == target.read_bytes()
    assert sniff(target) == "tremor"
    (before,), (after,) = decode(source).outcomes, decode(target).outcomes
    for field in ("start_unix_s", "duration_s", "fractions", "any_tremor"):
        np.testing.assert_array_equal(getattr(before, field), getattr(after, field))
    assert not any(secret in target.read_text() + repr(done) for secret in ("Jane", "Doe", "4711", "NPC1"))
    assert "other column" in done.removed[0]


def test_the_real_exports_keep_their_minutes_and_lose_their_identifiers(recordings, tmp_path):
    for name in ("strivepd_wide", "strivepd_long"):
        source, target = recordings / f"tremor/{name}.csv", tmp_path / f"{name}.csv"
        assert sniff(source) == "tremor"
        redact(source, target, "tremor", KEY)
        (before,), (after,) = decode(source).outcomes, decode(target).outcomes
        np.testing.assert_array_equal(before.fractions, after.fractions)
        np.testing.assert_array_equal(before.start_unix_s, after.start_unix_s)
        assert not any(secret in target.read_text() for secret in ("LARICRKw", "e3dd146f", "applewatch"))


@pytest.mark.parametrize(
    "text", ["t_us,hand,name\n1000000,L,Jane\n1100001,R,Jane\n2000000,L,Doe\n", "open_fist_s,name\n0.1,Jane\n0.7,Doe\n"]
)
def test_a_redacted_grasp_test_is_the_same_test(tmp_path, text):
    source, target = tmp_path / "s.csv", tmp_path / "t.csv"
    source.write_text(text)
    assert sniff(source) == "grasp"
    redact(source, target, "grasp", KEY)
    assert sniff(target) == "grasp"
    before, after = decode(source).outcomes, decode(target).outcomes
    assert [g.hand for g in before] == [g.hand for g in after]
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a.open_fist_s, b.open_fist_s)
    assert not any(secret in target.read_text() for secret in ("Jane", "Doe"))


def test_a_redacted_table_of_raw_lfp_is_the_same_recording(tmp_path, same_recording):
    t = np.arange(1, 2501) / 250.0
    rows = "".join(f"{x:.3f},{v:.4f},1.5,Jane\n" for x, v in zip(t, np.sin(2 * np.pi * 20 * t), strict=True))
    source, target = tmp_path / "s.csv", tmp_path / "t.csv"
    source.write_text("t_s,lfp_mV,amplitude_ma,name\n" + rows)
    done = redact(source, target, "csv", KEY)
    assert [text.split(":")[0] for text in done.removed] == ["1 other column"]
    assert "Jane" not in target.read_text()
    assert same_recording(decode(source).recordings[0], decode(target).recordings[0])


@given(
    shares=st.lists(st.lists(st.floats(0, 1), min_size=6, max_size=6).filter(lambda s: sum(s) > 0.1), min_size=1, max_size=8),
    first=st.integers(1_500_000_000, 1_900_000_000),
)
def test_any_minutes_survive_redaction_bit_by_bit(tmp_path_factory, shares, first):
    folder = tmp_path_factory.mktemp("t")
    lines = ["time,unknown,none,slight,mild,moderate,strong"]
    lines += [",".join([str(first + 60 * i), *(repr(v / sum(row)) for v in row)]) for i, row in enumerate(shares)]
    (folder / "s.csv").write_text("\n".join(lines))
    redact(folder / "s.csv", folder / "t.csv", "tremor", KEY)
    (before,), (after,) = decode(folder / "s.csv").outcomes, decode(folder / "t.csv").outcomes
    np.testing.assert_array_equal(before.fractions, after.fractions)
    np.testing.assert_array_equal(before.any_tremor, after.any_tremor)
