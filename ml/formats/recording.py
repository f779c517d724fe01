"""Result of a decoder: recordings with their 2 s traces and events, and one report per file.

Everything here is plain data. Times are seconds in the recording's own clock unless a name says otherwise; where that clock starts is
`RecordingLog.started_at` (UTC), when the file states it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

DECODE_VERSION = 11
"""Raised whenever a decoder would give other numbers for the same bytes; traces are stored per version."""

TraceSource = Literal["time_domain", "device_power", "percept_lfp", "device_log", "table"]
Clock = Literal["device", "pc", "table"]
Hemisphere = Literal["left", "right"]


class UndecodableFile(Exception):
    """A file of which nothing can be used: what is wrong, where, and what to do about it, in the user's words.

    `what` and `where` may quote the file and are for its sender alone. `stored_what` and `stored_where` say the same without the file's own
    texts, which may identify a person. A stored report may contain them. They are equal where not given.
    """

    def __init__(self, what: str, where: str, hint: str, stored_what: str | None = None, stored_where: str | None = None) -> None:
        super().__init__(f"{what} ({where}). {hint}")
        self.what = what
        self.where = where
        self.hint = hint
        self.stored_what = what if stored_what is None else stored_what
        self.stored_where = where if stored_where is None else stored_where

    def __reduce__(self) -> tuple[type[UndecodableFile], tuple[str, ...]]:
        return UndecodableFile, self.args_of()

    def args_of(self) -> tuple[str, str, str, str, str]:
        """Return the arguments that make the same error again, in another process too."""
        return self.what, self.where, self.hint, self.stored_what, self.stored_where

    @property
    def for_sender(self) -> Problem:
        """The problem for the person who sent the file."""
        return Problem(self.what, self.where, self.hint)

    @property
    def stored(self) -> Problem:
        """The problem without texts of the file."""
        return Problem(self.stored_what, self.stored_where, self.hint)


@dataclass(frozen=True, slots=True)
class Problem:
    """Reason why a file, or a part of it, could not be used."""

    what: str
    where: str
    hint: str


@dataclass(frozen=True, slots=True)
class FileReport:
    """Report on one file of an upload. Every list has sentences for the person who uploaded it."""

    name: str
    understood: list[str] = field(default_factory=list)
    repaired: list[str] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)
    flagged: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    problem: Problem | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TraceLog:
    """One stream on the recording's common grid.

    Row i covers (t_end_first_s + (i - 1) * dt_s, t_end_first_s + i * dt_s]. `values` has shape [n], float32, NaN where `valid` (bool, [n])
    is false. `details` says how the values were made (band edges, gain, settings); the same keys for the same source.
    """

    stream: str
    channel: str
    unit: str
    source: TraceSource
    dt_s: float
    t_end_first_s: float
    values: NDArray[np.float32]
    valid: NDArray[np.bool_]
    details: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.values.ndim != 1 or self.values.shape != self.valid.shape:
            raise ValueError(f"values {self.values.shape} and valid {self.valid.shape} of {self.stream} must be the same [n]")

    @property
    def t_end_s(self) -> NDArray[np.float64]:
        """End of every row, shape [n], s."""
        return self.t_end_first_s + self.dt_s * np.arange(self.values.size, dtype=np.float64)

    def same_as(self, other: TraceLog) -> bool:
        """Compare every field, NaN counted equal to NaN."""
        named = ("stream", "channel", "unit", "source", "dt_s", "t_end_first_s", "details")
        return (
            all(getattr(self, name) == getattr(other, name) for name in named)
            and np.array_equal(self.valid, other.valid)
            and np.array_equal(self.values, other.values, equal_nan=True)
        )


Stretch = tuple[float, float, NDArray[np.float64]]
"""A gap-free piece of signal: time of its first sample in s of the recording's clock, rate in Hz, samples."""


@dataclass(frozen=True, slots=True, eq=False)
class SampleLog:
    """Samples of one channel as they were measured, gap-free stretches one after the other.

    Attributes:
        channel: as in the traces. unit: of the samples, e.g. `uV`.
        t_s: time of each sample in the recording's clock, s, [n], increasing within a stretch.
        values: samples, float32, [n].
        rates_hz: rates that occur, ascending.
        starts: index of the first sample of each stretch, [k]; before it samples are missing.
    """

    channel: str
    unit: str
    t_s: NDArray[np.float64]
    values: NDArray[np.float32]
    rates_hz: tuple[float, ...]
    starts: NDArray[np.int64]

    @staticmethod
    def of(channel: str, unit: str, stretches: Sequence[Stretch]) -> SampleLog:
        """Join the samples of stretches in their order."""
        sizes = [x.size for _, _, x in stretches]
        t_s = [start + np.arange(x.size) / rate for start, rate, x in stretches]
        return SampleLog(
            channel,
            unit,
            np.concatenate([np.empty(0), *t_s]),
            np.concatenate([np.empty(0), *(x for _, _, x in stretches)]).astype(np.float32),
            tuple(sorted({rate for _, rate, _ in stretches})),
            np.cumsum([0, *sizes[:-1]], dtype=np.int64)[: len(sizes)],
        )

    def stretches(self) -> list[Stretch]:
        """Cut the samples at their gaps; a stretch of one sample has the highest rate."""
        ends = [*self.starts[1:].tolist(), self.values.size]
        out: list[Stretch] = []
        for begin, end in zip(self.starts.tolist(), ends, strict=True):
            t_s = self.t_s[begin:end]
            step = (t_s[-1] - t_s[0]) / (t_s.size - 1) if t_s.size > 1 else 1.0 / self.rates_hz[-1]
            rate = min(self.rates_hz, key=lambda hz: abs(hz * step - 1.0))
            out.append((float(t_s[0]), rate, self.values[begin:end].astype(np.float64)))
        return out

    def between(self, begin_s: float, end_s: float) -> SampleLog:
        """Select the samples after `begin_s` and up to `end_s`, to the microsecond, as rows of traces take them."""
        inside = np.flatnonzero((self.t_s > begin_s + 1e-6) & (self.t_s <= end_s + 1e-6))
        first = np.zeros(self.t_s.size, dtype=bool)
        first[self.starts] = True
        first = first[inside]
        if inside.size:
            first[0] = True
            first[1:] |= np.diff(inside) > 1
        return replace(self, t_s=self.t_s[inside], values=self.values[inside], starts=np.flatnonzero(first))


@dataclass(frozen=True, slots=True, eq=False)
class SpectrumLog:
    """Power spectral density of one channel over a whole recording, without gaps.

    Attributes:
        channel: as in the traces. unit: e.g. `uV2/Hz`.
        hz, density: frequencies and density, both shape [n].
        seconds: how much signal it rests on.
    """

    channel: str
    unit: str
    hz: NDArray[np.float64]
    density: NDArray[np.float64]
    seconds: float

    def same_as(self, other: SpectrumLog) -> bool:
        """Compare every field."""
        named = (self.channel, self.unit, self.seconds) == (other.channel, other.unit, other.seconds)
        return named and np.array_equal(self.hz, other.hz) and np.array_equal(self.density, other.density)


@dataclass(frozen=True, slots=True, eq=False)
class OutcomeLog:
    """Base of what one table says of an outcome; `ml.formats.tables.outcome_tables` has its kinds."""


@dataclass(frozen=True, slots=True)
class EventLog:
    """Something that happened at one time: a stimulation step, an operator's label, a change of settings."""

    t_s: float
    kind: str
    label: str
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RecordingLog:
    """One recording of one device in one clock.

    `device_key` is opaque and may still be a serial number: decode redacted bytes, or replace it, before anything is stored. `fingerprint`
    is a SHA-256 over the decoded content without the device's name, so the same recording in another archive has the same. `run` says which
    recordings of one file were made together and so belong to one session. Examples are the two sides of a Percept, the two implants of a
    participant. It is None for what is no session: surveys, tests, a device's history. `samples` are there only where they were requested
    (`DecodeOptions.keep_samples`).
    """

    kind: str
    device_key: str | None
    hemisphere: Hemisphere | None
    clock: Clock
    started_at: datetime | None
    duration_s: float
    traces: tuple[TraceLog, ...]
    events: tuple[EventLog, ...]
    limits: Mapping[str, Any]
    settings: Mapping[str, Any]
    quality: Mapping[str, Any]
    fingerprint: str
    spectra: tuple[SpectrumLog, ...] = ()
    run: int | None = 0
    samples: tuple[SampleLog, ...] = ()


@dataclass(frozen=True, slots=True)
class DecodedFile:
    """Everything one uploaded file gave: recordings of a device, or measurements of an outcome."""

    recordings: tuple[RecordingLog, ...]
    reports: tuple[FileReport, ...]
    outcomes: tuple[OutcomeLog, ...] = ()


def fingerprint(kind: str, parts: Iterable[str | bytes | NDArray[Any]]) -> str:
    """Compute the SHA-256 (hex) over the kind and the parts in order; every part is length-prefixed so that no two lists of parts
    collide."""
    digest = hashlib.sha256()
    for part in (kind, *parts):
        raw = part.encode() if isinstance(part, str) else part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes()
        digest.update(len(raw).to_bytes(8, "little"))
        digest.update(raw)
    return digest.hexdigest()
