"""Columns between numpy and Arrow: the same values, the same bytes of a file, and no pandas."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ml.arrow import to_arrow, to_numpy

ROOT = Path(__file__).resolve().parents[2]
COLUMNS = {
    "int64": np.arange(-3, 4, dtype=np.int64),
    "int32": np.arange(7, dtype=np.int32),
    "float64": np.array([0.1, np.nan, -np.inf, 5e-324, -0.0]),
    "float32": np.array([0.1, np.nan], np.float32),
    "every other": np.arange(10.0)[::2],
    "empty": np.empty(0),
}


@pytest.mark.parametrize("values", COLUMNS.values(), ids=COLUMNS)
def test_a_column_comes_back_as_it_was(values: np.ndarray) -> None:
    column = to_arrow(values)
    assert column.equals(pa.array(values)) or np.isnan(values).any()
    column.validate(full=True)
    again = to_numpy(pa.chunked_array([column]))
    assert (again.dtype, again.flags.writeable) == (values.dtype, True)
    np.testing.assert_array_equal(again.view(np.uint8), np.ascontiguousarray(values).view(np.uint8))


@pytest.mark.parametrize("values", COLUMNS.values(), ids=COLUMNS)
def test_a_file_has_the_bytes_that_the_library_itself_writes(values: np.ndarray) -> None:
    def written(column: object) -> bytes:
        sink = io.BytesIO()
        pq.write_table(pa.table({"a": column}), sink, compression="zstd")
        return sink.getvalue()

    assert written(to_arrow(values)) == written(values)


def test_chunks_and_slices_are_put_together() -> None:
    whole = pa.chunked_array([to_arrow(np.arange(4)), to_arrow(np.arange(4, 9))])
    assert to_numpy(whole).tolist() == list(range(9))
    assert to_numpy(whole.slice(2, 5)).tolist() == [2, 3, 4, 5, 6]
    assert to_numpy(pa.chunked_array([], pa.int32())).dtype == np.int32


@pytest.mark.parametrize("values", [np.zeros((2, 2)), np.array(["a"]), np.array([True]), np.array([None])])
def test_what_is_no_row_of_numbers_is_refused(values: np.ndarray) -> None:
    with pytest.raises(ValueError, match="an Arrow column is made of one row of numbers"):
        to_arrow(values)


def test_missing_values_are_refused() -> None:
    with pytest.raises(ValueError, match="1 of 3 values are missing"):
        to_numpy(pa.chunked_array([pa.array([1, None, 3])]))


def test_a_snapshot_is_written_and_read_without_pandas() -> None:
    code = """
import sys
from tests.ml.test_trajectories import SETTINGS, ReplayBuffer, from_parquet, session, to_parquet
from_parquet(to_parquet(ReplayBuffer(SETTINGS, (session(1),), "uV", "table")))
print(*({"pyarrow", "pandas"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["pyarrow"]
