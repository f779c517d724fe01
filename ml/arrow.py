"""Columns between numpy and Arrow.

Arrow's own conversions import pandas where it is installed: 55 MB and half a second of each process that reads one snapshot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pyarrow as pa


def to_arrow(values: NDArray[Any]) -> pa.Array:
    """Return numbers as an Arrow array of the same type and the same memory.

    Args:
        values: integers or floats, [n]; NaN stays NaN.

    Raises:
        ValueError: they are no plain column of numbers.
    """
    import pyarrow as pa

    if values.ndim != 1 or values.dtype.kind not in "iuf":
        raise ValueError(f"an Arrow column is made of one row of numbers, not of {values.dtype} with {values.ndim} dimensions")
    contiguous = np.ascontiguousarray(values)
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), values.size, [None, pa.py_buffer(contiguous)])


def to_numpy(column: pa.ChunkedArray) -> NDArray[Any]:
    """Return a column of numbers as a numpy array of the same type, [n].

    Raises:
        ValueError: a value is missing.
    """
    if column.null_count:
        raise ValueError(f"{column.null_count} of {len(column)} values are missing")
    parts = [np.from_dlpack(chunk) for chunk in column.chunks]
    return np.concatenate(parts) if parts else np.empty(0, column.type.to_pandas_dtype())
