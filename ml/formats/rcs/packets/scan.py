"""Compiled reading of plain RC+S stream packets: bytes in, float arrays out, no Python object per number.

A packet is plain when it is strict JSON with nothing but the fields of format notes A.2 to A.4. Each field comes once, with a value of the
right kind. Everything else, damage included, is left to the tolerant reader of `json_elements`; `batch_of` gives its packets the same
shape.

A number whose digits fit 53 bits and whose decimal shift is at most 22 is one correctly rounded operation on exact doubles. The others,
such as 0.040411999999999997, are left to `float`, so that every value is the one that any JSON parser gives.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ml.formats.rcs.settings import get, number

__all__ = ["ARRAYS", "PADDING", "SCALARS", "Batch", "batch_of", "join", "scan"]

SCALARS: Final = (
    "dataTypeSequence", "systemTick", "seconds", "PacketGenTime", "PacketRxUnixTime", "SampleRate", "FftSize", "ValidDataMask",
    "IsPowerChannelOverrange", "Channel", "LatencyMilliseconds",
)  # fmt: skip
"""Numbers and flags kept per packet, in the order of the columns of `Batch.scalars`."""

ARRAYS: Final = ("key 0", "key 1", "key 2", "key 3", "XSamples", "YSamples", "ZSamples", "Bands", "FftOutput")
"""Arrays kept per packet, in the order of `Batch.starts` and `Batch.lengths`; the first four are time-domain channels."""

PADDING: Final = b"\0" * 64
"""Put after the text so that the scanner may look ahead of its end without asking."""
_PATHS: Final[dict[str, tuple[str, ...]]] = {
    "dataTypeSequence": ("Header", "dataTypeSequence"),
    "systemTick": ("Header", "systemTick"),
    "seconds": ("Header", "timestamp", "seconds"),
}
_NUMBER_TEXT: Final = re.compile(rb"[-+.0-9eE]+")

_SHORTEST_PACKET: Final = 64
_SHORTEST_HARD: Final = 4  # such as 9e99
_MAX_BATCH: Final = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Packets in file order.

    Attributes:
        scalars: shape [n, len(SCALARS)]; NaN where the packet has no such number; flags are 0 or 1.
        starts, lengths: place of each of ARRAYS in `pool`, shape [n, len(ARRAYS)]; length -1 where the packet has none.
        pool: the arrays' numbers one after another, shape [m]; NaN for what is no finite number.
    """

    scalars: NDArray[np.float64]
    starts: NDArray[np.int64]
    lengths: NDArray[np.int64]
    pool: NDArray[np.float64]

    @property
    def size(self) -> int:
        """Number of packets n."""
        return int(self.scalars.shape[0])

    def column(self, name: str) -> NDArray[np.float64]:
        """Return one of SCALARS, shape [n]."""
        return self.scalars[:, SCALARS.index(name)]


def scan(text: bytes, at: int) -> tuple[Batch, int, bool]:
    """Read plain packets from `text[at] == "{"` on, each followed by one comma at most.

    Args:
        text: ASCII with `PADDING` behind it.
        at: where the first packet begins.

    Returns:
        The packets (perhaps none), where the last of them ends, and whether the next one may only be cut by the end of the text.
    """
    from ml.formats.rcs.packets._scan_kernel import read_packets  # numba takes a third of a second of every process that starts

    raw = np.frombuffer(text, dtype=np.uint8)
    end = raw.size - len(PADDING)
    capacity = min(_MAX_BATCH, (end - at) // _SHORTEST_PACKET + 1)
    scalars = np.full((capacity, len(SCALARS)), np.nan)
    starts = np.zeros((capacity, len(ARRAYS)), dtype=np.int64)
    lengths = np.full((capacity, len(ARRAYS)), -1, dtype=np.int64)
    pool = np.empty((end - at) // 2 + 1)
    hard = np.empty(((end - at) // _SHORTEST_HARD + 1, 2), dtype=np.int64)
    count, used, difficult, stop, failed = read_packets(raw, at, end, scalars, starts, lengths, pool, hard)
    for place, target in hard[:difficult].tolist():
        found = _NUMBER_TEXT.match(text, place)
        value = number(float(found[0])) if found else None
        (pool if target >= 0 else scalars.reshape(-1))[target if target >= 0 else -1 - target] = np.nan if value is None else value
    return Batch(scalars[:count], starts[:count], lengths[:count], pool[:used]), int(stop), bool(failed >= end - len(PADDING))


def batch_of(packets: Iterable[Any]) -> Batch:
    """Build a batch from parsed JSON values of whatever shape: the definition of what `scan` reads."""
    scalars: list[list[float]] = []
    starts: list[NDArray[np.int64]] = []
    lengths: list[list[int]] = []
    pool: list[float] = []
    for packet in packets:
        scalars.append([_scalar(packet, name) for name in SCALARS])
        row = [list[float]() for _ in ARRAYS]
        size = [-1] * len(ARRAYS)
        for slot, values in _arrays(packet):
            if size[slot] < 0 and isinstance(values, list):
                row[slot] = [float("nan") if (v := number(item)) is None else v for item in values]
                size[slot] = len(values)
        starts.append(len(pool) + np.concatenate(([0], np.cumsum([len(values) for values in row])[:-1])))
        lengths.append(size)
        pool.extend(value for values in row for value in values)
    shape = (-1, len(ARRAYS))
    return Batch(
        np.array(scalars, dtype=np.float64).reshape(-1, len(SCALARS)),
        np.array(starts, dtype=np.int64).reshape(shape),
        np.array(lengths, dtype=np.int64).reshape(shape),
        np.array(pool, dtype=np.float64),
    )


def _scalar(packet: Any, name: str) -> float:
    if name == "IsPowerChannelOverrange":
        found = get(packet, name)
        return float(found) if isinstance(found, bool) else float("nan")
    value = number(get(packet, *_PATHS.get(name, (name,))))
    return float("nan") if value is None else value


def _arrays(packet: Any) -> Iterable[tuple[int, Any]]:
    """Yield (slot, values) of the arrays of a packet."""
    listed = get(packet, "ChannelSamples")
    for channel in listed if isinstance(listed, list) else ():
        key = number(get(channel, "Key"))
        if key in (0.0, 1.0, 2.0, 3.0):
            yield int(key), get(channel, "Value")
    for slot in range(4, len(ARRAYS)):
        yield slot, get(packet, ARRAYS[slot])


def join(batch: Batch, name: str, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Join one array of the given packets, one after another, shape [sum of lengths]; packets without it add nothing."""
    from ml.formats.rcs.packets._scan_kernel import copy_runs

    slot = ARRAYS.index(name)
    lengths = np.maximum(batch.lengths[rows, slot], 0)
    out = np.empty(int(lengths.sum()))
    copy_runs(batch.pool, batch.starts[rows, slot], lengths, out)
    return out
