"""Runs: channels and powers of a Percept report that were streamed together. Source: format notes, A′."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime

from ml.formats.facts.counters import shift_by_turns
from ml.formats.percept.streams import TURN_MS, DevicePower, TimeDomain
from ml.formats.recording import FileReport

SAME_RUN_MS = 2_000.0
"""First ticks of one run's channels lie this close together."""

SAME_RUN_S = 2.0
"""Programmer's times of one run lie this close together where there are no ticks."""

MOSTLY = 0.8
"""Share of the shorter one of samples and power that the other must cover to be of the same run."""


@dataclass(slots=True)
class Run:
    """One streaming run: channels of samples, and the device's power with the amplitude."""

    channels: list[TimeDomain] = field(default_factory=list)
    power: DevicePower | None = None

    @property
    def first_packet(self) -> datetime | None:
        """Time of the programmer at the first packet: of the samples where there are any."""
        dated = [c for c in self.channels if c.first_packet]
        known = min(dated, key=lambda c: c.begin_ms).first_packet if dated else None
        return known or (self.power.first_packet if self.power else None)

    @property
    def power_origin_ms(self) -> float:
        """Begin of the power's first interval, in the ticks that the run's span is in."""
        if self.power is None:
            return 0.0
        first = float(self.power.ticks_ms[0]) - self.power.interval_ms
        # samples without ticks begin at 0, and the power is taken to begin with them
        return first if not self.channels or self.channels[0].ticked else 0.0

    @property
    def span_ms(self) -> tuple[float, float]:
        """Begin and end in ticks; from 0 where the samples have none."""
        begins = [c.begin_ms for c in self.channels]
        ends = [c.end_ms for c in self.channels]
        if self.power is not None:
            begins.append(self.power_origin_ms)
            ends.append(self.power_origin_ms + float(self.power.ticks_ms[-1] - self.power.ticks_ms[0]) + self.power.interval_ms)
        return min(begins), max(ends)


def pair_runs(channels: list[TimeDomain], powers: list[DevicePower], said: FileReport) -> list[Run]:
    """Pair channels and powers that were streamed together, in the order of the file.

    They pair by channel, by ticks modulo a turn of their counter, and by FirstPacketDateTime. The date has seconds only and may differ by
    one within a run. Where ticks fit and dates do not, the ticks of two runs are equal by chance.
    """
    runs: list[Run] = []
    for channel in channels:
        run = next((r for r in runs if _same_run(r, channel)), None)
        if run is None:
            run = Run()
            runs.append(run)
        elif channel.ticked:
            channel.meet(run.channels[0].begin_ms)
        run.channels.append(channel)
    for power in powers:
        fits = [(fit, r) for r in runs if r.power is None and (fit := _fit(r, power)) is not None]
        dated = [(fit, r) for fit, r in fits if fit.seconds <= SAME_RUN_S]
        # without dates, runs that fit after another number of turns cannot be distinguished
        best = min(dated, key=lambda pair: (pair[0].seconds, pair[0].apart_ms), default=None)
        if best is not None and any(not fit.dated and r is not best[1] for fit, r in dated):
            said.flagged.append(f"the power of {_channels_in_words(power)} fits several runs and a date is missing: it is a run of its own")
            best = None
        elif best is None and fits:
            said.flagged.append(
                f"the ticks of the power of {_channels_in_words(power)} fit a run's samples, but the report dates them "
                f"{min(fit.seconds for fit, _ in fits):.0f} s apart: they are two runs"
            )
        if best is None:
            runs.append(Run(power=power))
        else:
            power.shift(best[0].turns_ms)
            best[1].power = power
    return runs


def _channels_in_words(power: DevicePower) -> str:
    return ", ".join(power.channels) or "an unnamed channel"


def _same_run(run: Run, channel: TimeDomain) -> bool:
    """Recognise another channel of the run: another name, and ticks or else times that begin together. A difference equal to its lost first
    packets is allowed.

    Where the first packets of one side were lost, ticks and times of that side begin later by the same amount. The two then continue
    together.
    """
    if any(c.channel == channel.channel for c in run.channels):
        return False
    other = run.channels[0]
    if other.ticked != channel.ticked:
        return False
    if not other.ticked:
        return apart_s(other.first_packet, channel.first_packet) <= SAME_RUN_S
    turns_ms = shift_by_turns(channel.begin_ms, other.begin_ms, TURN_MS)
    later_ms = channel.begin_ms + turns_ms - other.begin_ms
    if abs(later_ms) <= SAME_RUN_MS:
        return apart_s(other.first_packet, channel.first_packet) <= SAME_RUN_S
    if other.first_packet is None or channel.first_packet is None:
        return False
    begin, end = max(channel.begin_ms + turns_ms, other.begin_ms), min(channel.end_ms + turns_ms, other.end_ms)
    together = end - begin >= MOSTLY * min(channel.end_ms - channel.begin_ms, other.end_ms - other.begin_ms)
    return together and abs((channel.first_packet - other.first_packet).total_seconds() - later_ms / 1000.0) <= SAME_RUN_S


@dataclass(frozen=True, slots=True)
class _Fit:
    """Fit of a power to a run.

    Attributes:
        turns_ms: to add to the power's ticks. apart_ms: distance of the first ticks then.
        seconds: what the dates differ by, more than the ticks do; 0 where one is missing. dated: both have a date.
    """

    turns_ms: float
    apart_ms: float
    seconds: float
    dated: bool


def _fit(run: Run, power: DevicePower) -> _Fit | None:
    """Fit a power to a run: of one of its channels, and beginning with it. Power whose first values were lost is within the run.

    Of several numbers of turns the dates decide.
    """
    if power.channels and not {c.channel for c in run.channels} & set(power.channels):
        return None
    dated = run.first_packet is not None and power.first_packet is not None
    difference_s = (power.first_packet - run.first_packet).total_seconds() if run.first_packet and power.first_packet else 0.0
    if not run.channels or not run.channels[0].ticked:
        return _Fit(0.0, 0.0, abs(difference_s), dated) if run.channels else None
    first, last = float(power.ticks_ms[0]) - power.interval_ms, float(power.ticks_ms[-1])
    begin, end = run.span_ms
    nearest_ms = shift_by_turns(first, begin, TURN_MS)
    found = []
    for turns_ms in (nearest_ms + k * TURN_MS for k in range(int((end - begin) // TURN_MS) + 2)):
        later_ms = first + turns_ms - begin
        within = min(end, last + turns_ms) - max(begin, first + turns_ms) >= MOSTLY * min(end - begin, last - first)
        if abs(later_ms) <= SAME_RUN_MS or within:
            # the date of a power whose first values are lost may be that of its run
            seconds = min(abs(difference_s), abs(difference_s - later_ms / 1000.0)) if dated else 0.0
            found.append(_Fit(turns_ms, abs(later_ms), seconds, dated))
    return min(found, key=lambda fit: (fit.seconds > SAME_RUN_S, fit.apart_ms), default=None)


def apart_s(one: datetime | None, other: datetime | None) -> float:
    """Compute the seconds between two times; 0 where either is unknown."""
    return abs((one - other).total_seconds()) if one and other else 0.0
