"""RC+S device settings and stimulation log: delta records merged into the state in force at every time. Source: format notes, A.5, A.6."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

RATE_HZ = {0: 250.0, 1: 500.0, 2: 1000.0}
FFT_SIZE = {0: 64, 1: 256, 3: 1024}
ADAPTIVE_BIT = 128
GROUPS = "ABCD"
SENSING_SECTIONS = frozenset({"SensingConfig", "SenseState"})
THERAPY_SECTIONS = frozenset({"GeneralData", "therapyStatusData"})
"""Sections that sensing and stimulation are read from, in addition to the therapy groups; a record without them changes neither."""

T = TypeVar("T")


def get(node: Any, *path: str | int) -> Any:
    """Return the value below a path of keys and indices; None where the path ends early."""
    for step in path:
        if isinstance(node, dict) and isinstance(step, str):
            node = node.get(step)
        elif isinstance(node, list) and isinstance(step, int) and 0 <= step < len(node):
            node = node[step]
        else:
            return None
    return node


def number(value: Any) -> float | None:
    """Read a finite number, or None for anything else (text, truth values, NaN)."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not -1e300 < value < 1e300:
        return None
    return None if math.isnan(value) else float(value)


def integer(value: Any, bits: int = 62) -> int | None:
    """Read a whole number of at most so many bits, or None for anything else."""
    found = number(value)
    return int(found) if found is not None and found == int(found) and abs(found) < 2**bits else None


def merge(old: Any, new: Any) -> Any:
    """Merge a delta into the running state: objects merge key by key, lists of objects of equal length item by item. All else is
    replaced."""
    if isinstance(old, dict) and isinstance(new, dict):
        return {**old, **{key: merge(old.get(key), value) for key, value in new.items()}}
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new) and all(isinstance(item, dict) for item in new):
        return [merge(a, b) for a, b in zip(old, new, strict=True)]
    return new


@dataclass(frozen=True, slots=True)
class Band:
    """One on-device power band: bin indices inclusive, edges in Hz with the half bin on either side."""

    channel: int
    index: int
    low_hz: float
    high_hz: float

    @property
    def name(self) -> str:
        """Channel name of the band's trace, bands counted from one."""
        return f"band {self.index + 1} {self.low_hz:.1f}-{self.high_hz:.1f} Hz"


@dataclass(frozen=True, slots=True)
class Program:
    """One stimulation program as set."""

    enabled: bool | None
    amplitude_ma: float | None
    pulse_width_us: float | None


@dataclass(frozen=True, slots=True)
class Sensing:
    """Sensing in force: contact pairs per time-domain key, FFT interval, bands."""

    rates_hz: tuple[float | None, ...] = (None,) * 4
    contacts: tuple[str, ...] = ("",) * 4
    fft_interval_s: float | None = None
    fft_size: int | None = None
    bands: tuple[Band | None, ...] = (None,) * 8
    sense_bits: int | None = None


@dataclass(frozen=True, slots=True)
class Therapy:
    """Stimulation in force: status, active group and its four programs."""

    on: bool | None = None
    group: int | None = None
    rate_hz: float | None = None
    programs: tuple[Program, ...] = ()


@dataclass(slots=True)
class Timeline(Generic[T]):
    """States and the PC times (ms) from which they hold."""

    times_ms: list[float] = field(default_factory=list)
    states: list[T] = field(default_factory=list)

    def add(self, time_ms: float, state: T) -> None:
        """Append a state unless it equals the last one."""
        if not self.states or self.states[-1] != state:
            self.times_ms.append(max(time_ms, self.times_ms[-1]) if self.times_ms else time_ms)
            self.states.append(state)

    def at(self, time_ms: float) -> T | None:
        """Find the state in force; the first one for times before it."""
        if not self.states:
            return None
        return self.states[max(0, bisect.bisect_right(self.times_ms, time_ms) - 1)]


def sensing_of(state: dict[str, Any]) -> Sensing:
    """Read sensing from a merged settings state."""
    config = get(state, "SensingConfig")
    rates = tuple(
        RATE_HZ.get(integer(get(config, "timeDomainChannels", k, "sampleRate")) or 0) if _has_rate(config, k) else None for k in range(4)
    )
    interval = number(get(config, "fftConfig", "interval"))
    size = FFT_SIZE.get(integer(get(config, "fftConfig", "size")) or 0)
    rate = next((r for r in rates if r is not None), None)
    return Sensing(
        rates_hz=rates,
        contacts=tuple(_contacts(config, k) for k in range(4)),
        fft_interval_s=interval / 1000.0 if interval and interval > 0 else None,
        fft_size=size,
        bands=tuple(_band(config, i, rate, size) for i in range(8)),
        sense_bits=integer(get(state, "SenseState", "state")),
    )


def _has_rate(config: Any, key: int) -> bool:
    return integer(get(config, "timeDomainChannels", key, "sampleRate")) in RATE_HZ


def _contacts(config: Any, key: int) -> str:
    """Read the contact pair, such as `+2-0`; one-hot masks, contacts of the second bore counted from 8; empty when unknown."""

    def contact(field_name: str) -> str:
        mask = integer(get(config, "timeDomainChannels", key, field_name))
        if mask is None or mask < 0:
            return "?"
        return "floating" if mask == 0 else str(mask.bit_length() - 1 + (8 if key >= 2 else 0))

    if get(config, "timeDomainChannels", key) is None:
        return ""
    return f"+{contact('plusInput')}-{contact('minusInput')}"


def _band(config: Any, index: int, rate_hz: float | None, size: int | None) -> Band | None:
    """Compute the edges in Hz: bin k is centred on k * width, so a band runs half a bin beyond its first and last bin."""
    start = integer(get(config, "powerChannels", index // 2, f"band{index % 2}Start"))
    stop = integer(get(config, "powerChannels", index // 2, f"band{index % 2}Stop"))
    if start is None or stop is None or rate_hz is None or size is None:
        return None
    width = rate_hz / size
    return Band(index // 2, index, max(0.0, (start - 0.5) * width), (stop + 0.5) * width)


def therapy_of(state: dict[str, Any], stim: dict[str, Any] | None) -> Therapy:
    """Read stimulation as set: from the stimulation log's state where there is one, enabled programs always from the settings."""
    status = merge(get(state, "GeneralData", "therapyStatusData") or {}, get(stim, "therapyStatusData") or {})
    group = integer(get(status, "activeGroup"))
    on = integer(get(status, "therapyStatus"))
    if group is None or not 0 <= group <= 3:
        return Therapy(on=None if on is None else on == 1)
    settings, log = get(state, f"TherapyConfigGroup{group}"), get(stim, f"TherapyConfigGroup{group}")
    programs = []
    for p in range(4):
        enabled = integer(get(settings, "programs", p, "isEnabled"))
        amplitude = number(get(log, f"program{p}", "AmplitudeInMilliamps"))
        width = number(get(log, f"program{p}", "PulseWidthInMicroseconds"))
        programs.append(
            Program(
                None if enabled is None else enabled == 0,
                number(get(settings, "programs", p, "amplitudeInMilliamps")) if amplitude is None else amplitude,
                number(get(settings, "programs", p, "pulseWidthInMicroseconds")) if width is None else width,
            )
        )
    rate = number(get(log, "RateInHz"))
    return Therapy(None if on is None else on == 1, group, number(get(settings, "rateInHz")) if rate is None else rate, tuple(programs))


def host_ms(record: Any) -> float | None:
    """Read the PC time of a record, ms."""
    time_ms = number(get(record, "RecordInfo", "HostUnixTime"))
    return time_ms if time_ms is not None and 0 < time_ms < 2.5e14 else None


@dataclass(slots=True)
class Settings:
    """Everything the settings and the stimulation log say, over time."""

    sensing: Timeline[Sensing]
    therapy: Timeline[Therapy]
    merged: dict[str, Any]
    stim_log: bool
    record_times_ms: list[float] = field(default_factory=list)

    def at_times(self, of_pc_ms: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Settings:
        """Move the settings' PC times onto a recording's timeline."""

        def moved(times_ms: list[float]) -> list[float]:
            times: list[float] = of_pc_ms(np.array(times_ms, dtype=np.float64)).tolist()
            return times

        sensing = Timeline(moved(self.sensing.times_ms), self.sensing.states)
        therapy = Timeline(moved(self.therapy.times_ms), self.therapy.states)
        return Settings(sensing, therapy, self.merged, self.stim_log, moved(self.record_times_ms))


def follow(settings: Iterable[Any], stim: Iterable[Any]) -> Settings:
    """Merge both delta logs in the order of the PC clock.

    Args:
        settings: records of DeviceSettings.json in file order.
        stim: records of StimLog.json in file order.
    """
    out = Settings(Timeline(), Timeline(), {}, False)
    moves = [(t, 0, i, r) for i, r in enumerate(settings) if (t := host_ms(r)) is not None]
    moves += [(t, 1, i, r) for i, r in enumerate(stim) if (t := host_ms(r)) is not None]
    out.record_times_ms = sorted(move[0] for move in moves)
    logged: dict[str, Any] | None = None
    for time_ms, origin, _, record in sorted(moves, key=lambda move: move[:3]):
        delta = {key: value for key, value in record.items() if key != "RecordInfo"}
        if origin == 0:
            out.merged = merge(out.merged, delta)
            if not out.sensing.states or not delta.keys().isdisjoint(SENSING_SECTIONS):
                out.sensing.add(time_ms, sensing_of(out.merged))
        else:
            logged = merge(logged or {}, delta)
        if logged is not None and (not out.therapy.states or _tells_therapy(delta)):
            out.therapy.add(time_ms, therapy_of(out.merged, logged))
    out.stim_log = logged is not None
    if logged is None:
        _therapy_from_settings(out, moves)
    return out


def _tells_therapy(delta: dict[str, Any]) -> bool:
    return any(key in THERAPY_SECTIONS or key.startswith("TherapyConfigGroup") for key in delta)


def _therapy_from_settings(out: Settings, moves: list[tuple[float, int, int, Any]]) -> None:
    """Read stimulation from the settings' own therapy groups, where there is no stimulation log."""
    state: dict[str, Any] = {}
    for time_ms, _, _, record in sorted(moves, key=lambda move: move[:3]):
        delta = {key: value for key, value in record.items() if key != "RecordInfo"}
        state = merge(state, delta)
        if not out.therapy.states or _tells_therapy(delta):
            out.therapy.add(time_ms, therapy_of(state, None))
