"""A session's signals as one Parquet table: a row per sample, a row group per channel."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from app.overview.samples.signal import Signal

_WORDS = pa.dictionary(pa.int32(), pa.string())
SCHEMA = pa.schema(
    [
        pa.field("recording", pa.int64()),
        pa.field("hemisphere", _WORDS),
        pa.field("stream", _WORDS),
        pa.field("channel", _WORDS),
        pa.field("unit", _WORDS),
        pa.field("t_s", pa.float64()),
        pa.field("value", pa.float32()),
    ]
)


def write_parquet(target: Path, signals: Sequence[Signal], about: Mapping[str, Any]) -> None:
    """Write the table; `about` stands as JSON under the key `betaloop` of its schema. An invalid row of a trace is null."""
    said = {**about, "rates_hz": {f"{s.recording} {s.channel}": s.rates_hz for s in signals if s.rates_hz}}
    schema = SCHEMA.with_metadata({"betaloop": json.dumps(said)})
    with pq.ParquetWriter(target, schema, compression="zstd") as out:
        for s in signals:
            n = s.values.size
            words = [_repeated(word, n) for word in (s.hemisphere, s.stream, s.channel, s.unit)]
            values = pa.array(s.values, type=pa.float32(), from_pandas=True)  # NaN becomes null
            out.write_table(pa.table([pa.array([s.recording] * n, pa.int64()), *words, pa.array(s.t_s), values], schema=schema))


def _repeated(word: str | None, n: int) -> pa.DictionaryArray:
    indices = pa.nulls(n, pa.int32()) if word is None else pa.array(np.zeros(n, np.int32))
    return pa.DictionaryArray.from_arrays(indices, pa.array([] if word is None else [word], pa.string()))
