"""RC+S device settings and stimulation log: delta records merged into the state in force at every time. Source: format notes, A.5, A.6."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ml.formats.dose import Cycle, Dose, Program, delivered_dose
from ml.formats.facts.sentinels import reading
from ml.formats.rcs.packets.facts import FACTS
from ml.formats.vouching import Disagreement, Vouching

RATE_HZ = {0: 250.0, 1: 500.0, 2: 1000.0}
FFT_SIZE = {0: 64, 1: 256, 3: 1024}
ADAPTIVE_BIT = 128
GROUPS = "ABCD"
PROGRAMS = 4
RECORDS_LOST = "RecordsLost"
"""Key of the record that a redacted log has in the place of lost ones, with their PC time where it is known."""

SENSING_SECTIONS = frozenset({"SensingConfig", "SenseState"})
ON_OF_STATUS: dict[int | None, bool] = {0: False, 1: True}
"""Therapy off and on. With any other status (lead test, transitions) what is delivered is unknown. Source: format notes, A.5."""

CYCLE_UNIT_S: dict[int | None, float] = {2: 1.0}
"""Length of a unit of cycle times, s. Codes 0 and 1 occur too. Their unit is in no source read so far, hence unknown."""

THERAPY_SECTIONS = frozenset({"GeneralData", "therapyStatusData"})
"""Sections that sensing and stimulation are read from, in addition to the therapy groups; a record without them changes neither."""

SAME_SESSION_MS = 7 * 86_400_000.0
"""No session lasts a week: a record further from the others has a wrong time."""

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
    """Stimulation in force: status, active group and its four programs, and whether it cycles."""

    on: bool | None = None
    group: int | None = None
    rate_hz: float | None = None
    programs: tuple[Program, ...] = ()
    cycle: Cycle | None = field(default=None, repr=False)


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


def therapy_of(state: dict[str, Any], stim: dict[str, Any] | None, lost: bool = False) -> Therapy:
    """Read stimulation as set: from the stimulation log's state where there is one, enabled programs always from the settings.

    With `lost` records of the log are missing: status and amplitudes are those that it stated since, and no older ones of the settings.
    """
    told = {} if lost else get(state, "GeneralData", "therapyStatusData") or {}
    status = merge(told, get(stim, "therapyStatusData") or {})
    group = integer(get(status, "activeGroup"))
    on = ON_OF_STATUS.get(integer(get(status, "therapyStatus")))
    if group is None or not 0 <= group <= 3:
        return Therapy(on=on)
    settings, log = get(state, f"TherapyConfigGroup{group}"), get(stim, f"TherapyConfigGroup{group}")
    programs = []
    for p in range(4):
        enabled = integer(get(settings, "programs", p, "isEnabled"))
        logged = get(log, f"program{p}")
        amplitude = number(get(logged, "AmplitudeInMilliamps"))
        width = number(get(log, f"program{p}", "PulseWidthInMicroseconds"))
        # a log whose statement cannot be read outdates what the settings stated before it
        if amplitude is None and not lost and not (isinstance(logged, dict) and "AmplitudeInMilliamps" in logged):
            amplitude = number(get(settings, "programs", p, "amplitudeInMilliamps"))
        if width is None:
            width = number(get(settings, "programs", p, "pulseWidthInMicroseconds"))
        programs.append(Program(None if enabled is None else enabled == 0, amplitude, width, limits_of(state, group, p)))
    rate = number(get(log, "RateInHz"))
    return Therapy(on, group, number(get(settings, "rateInHz")) if rate is None else rate, tuple(programs), _cycle(settings))


def limits_of(state: dict[str, Any], group: int, program: int) -> tuple[float, float] | None:
    """Read the clinician's amplitude limits of a program, mA."""
    stated = (number(get(state, f"AmplitudeLimitsGroup{group}", f"prog{program}{end}InMilliamps")) for end in ("Lower", "Upper"))
    low, high = (reading(limit, FACTS.fields["AmplitudeInMilliamps"]) for limit in stated)
    return None if low is None or high is None else (low, high)


def _cycle(group: Any) -> Cycle | None:
    """Read the cycling of a therapy group; None where it is continuous."""
    if not get(group, "cyclingEnabled"):
        return None
    on, off = (get(group, name) for name in ("cycleOnTime", "cycleOffTime"))
    return Cycle(_cycle_s(on), _cycle_s(off))


def _cycle_s(time: Any) -> float | None:
    """Read one length of a cycle, s; None for an unknown unit."""
    length, unit = number(get(time, "time")), CYCLE_UNIT_S.get(integer(get(time, "units")))
    return None if length is None or unit is None else length * unit


def host_ms(record: Any) -> float | None:
    """Read the PC time of a record, ms."""
    time_ms = number(get(record, "RecordInfo", "HostUnixTime"))
    return time_ms if time_ms is not None and 0 < time_ms < 2.5e14 else None


@dataclass(frozen=True, slots=True)
class Lost:
    """Place in a log where records are missing: it vouches for nothing from `from_ms` (PC clock) on; from its last record on where None."""

    from_ms: float | None = None


@dataclass(slots=True)
class Settings:
    """Everything the settings and the stimulation log say, over time.

    `lost`: whether records about stimulation are missing. `adaptive_lost`: the same of the adaptive log.
    `conflicts`: where both say different things.
    """

    sensing: Timeline[Sensing]
    therapy: Timeline[Therapy]
    merged: dict[str, Any]
    stim_log: bool
    record_times_ms: list[float] = field(default_factory=list)
    lost: bool = False
    adaptive_lost: bool = False
    conflicts: list[Disagreement] = field(default_factory=list)

    def at_times(self, of_pc_ms: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Settings:
        """Move the settings' PC times onto a recording's timeline."""

        def moved(times_ms: list[float]) -> list[float]:
            times: list[float] = of_pc_ms(np.array(times_ms, dtype=np.float64)).tolist()
            return times

        sensing = Timeline(moved(self.sensing.times_ms), self.sensing.states)
        therapy = Timeline(moved(self.therapy.times_ms), self.therapy.states)

        def moved_one(c: Disagreement) -> Disagreement:
            times = moved([c.at_ms, c.begin_ms, *(t for t, _ in c.logged)])
            end_ms = moved([c.end_ms])[0] if math.isfinite(c.end_ms) else c.end_ms
            logged = tuple(zip(times[2:], (dose for _, dose in c.logged), strict=True))
            return replace(c, at_ms=times[0], begin_ms=times[1], end_ms=end_ms, logged=logged)

        conflicts = [moved_one(c) for c in self.conflicts]
        return replace(self, sensing=sensing, therapy=therapy, record_times_ms=moved(self.record_times_ms), conflicts=conflicts)


def follow(settings: Iterable[Any], stim: Iterable[Any]) -> Settings:
    """Merge both delta logs in the order of the PC clock.

    The stimulation log says what was delivered. Where records of it are lost, the settings vouch for the moments at which they were read.

    Args:
        settings: records of DeviceSettings.json in file order.
        stim: records of StimLog.json in file order; a `Lost` where some are missing.
    """
    settings, stim = _replace_undated(list(settings), list(stim))
    out = Settings(Timeline(), Timeline(), {}, False)
    times = [t for record in (*settings, *stim) if not isinstance(record, Lost) and (t := host_ms(record)) is not None]
    moves = _moves(settings, 0, min(times, default=0.0)) + _moves(stim, 1, min(times, default=0.0))
    moves.sort(key=lambda move: move[:3])
    out.record_times_ms = sorted(times)
    vouching = Vouching(dose_of, Therapy())
    logged: dict[str, Any] | None = None
    since: dict[str, Any] = {}
    lost = False
    for time_ms, origin, _, record in moves:
        if isinstance(record, Lost):
            if origin == 1:
                vouching.log += [(time_ms, state) for state in out.therapy.states[-1:]]
                logged, since, lost = {}, {}, True
                out.therapy.add(time_ms, Therapy())
            continue
        delta = {key: value for key, value in record.items() if key != "RecordInfo"}
        if origin == 0:
            out.merged, since = merge(out.merged, delta), merge(since, delta)
            if not out.sensing.states or not delta.keys().isdisjoint(SENSING_SECTIONS):
                out.sensing.add(time_ms, sensing_of(out.merged))
            if any(key.startswith("TherapyConfigGroup") for key in delta):
                vouching.readings.append((time_ms, therapy_of(since, None)))
        else:
            logged = merge(logged or {}, delta)
        if logged is not None and (not out.therapy.states or tells_therapy(delta)):
            out.therapy.add(time_ms, therapy_of(out.merged, logged, lost))
            if origin == 1:
                vouching.log.append((time_ms, out.therapy.states[-1]))
    out.stim_log, out.lost = bool(logged), lost or (logged is None and any(isinstance(move[3], Lost) for move in moves))
    if logged is None:
        _therapy_from_settings(out, moves)
    else:
        course, out.conflicts = vouching.combine(out.therapy.times_ms, out.therapy.states)
        out.therapy = Timeline()
        for time_ms, state in course:
            out.therapy.add(time_ms, state)
    return out


def _replace_undated(settings: list[Any], stim: list[Any]) -> tuple[list[Any], list[Any]]:
    """Replace records without a time of their session by a `Lost`: what they changed was changed at an unknown moment.

    A PC writes milliseconds. A time in another unit, or of a clock that was not set, is far from that of the other records.
    """
    known = sorted(t for record in settings or stim if not isinstance(record, Lost) and (t := host_ms(record)) is not None)
    middle = known[len(known) // 2] if known else 0.0

    def replace_one(record: Any) -> Any:
        if isinstance(record, Lost) or not isinstance(record, dict) or record.keys() <= {"RecordInfo"}:
            return record
        time_ms = host_ms(record)
        return record if time_ms is not None and abs(time_ms - middle) <= SAME_SESSION_MS else Lost()

    return [replace_one(record) for record in settings], [replace_one(record) for record in stim]


def dose_of(therapy: Therapy) -> Dose:
    """Compute the dose under these settings.

    Without settings that say which programs are enabled, the first one is taken to be.
    """
    dose = delivered_dose(therapy.on, therapy.programs, therapy.cycle)
    return dose if len(dose.amplitude_ma) == PROGRAMS else replace(dose, amplitude_ma=dose.amplitude_ma[:1] * PROGRAMS)


def _moves(records: Iterable[Any], origin: int, first_ms: float) -> list[tuple[float, int, int, Any]]:
    """List records with their PC time in ms, the number of their log and their place in it; those without a time are excluded."""
    out: list[tuple[float, int, int, Any]] = []
    latest = first_ms
    for i, record in enumerate(records):
        time_ms = (latest if record.from_ms is None else max(record.from_ms, latest)) if isinstance(record, Lost) else host_ms(record)
        if time_ms is not None:
            out.append((time_ms, origin, i, record))
            latest = max(latest, time_ms)
    return out


def tells_therapy(delta: dict[str, Any]) -> bool:
    return any(key in THERAPY_SECTIONS or key.startswith("TherapyConfigGroup") for key in delta)


def _therapy_from_settings(out: Settings, moves: list[tuple[float, int, int, Any]]) -> None:
    """Read stimulation from the settings' own therapy groups, where there is no stimulation log."""
    state: dict[str, Any] = {}
    for time_ms, _, _, record in moves:
        if isinstance(record, Lost):
            state = {}
            out.therapy.add(time_ms, Therapy())
            continue
        delta = {key: value for key, value in record.items() if key != "RecordInfo"}
        state = merge(state, delta)
        if not out.therapy.states or tells_therapy(delta):
            out.therapy.add(time_ms, therapy_of(state, None))
