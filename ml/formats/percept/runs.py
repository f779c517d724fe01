"""Runs: channels and powers of a Percept report that were streamed together. Source: format notes, A′."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime

from ml.formats.percept.streams import DevicePower, TimeDomain
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

    By ticks and channel: FirstPacketDateTime has seconds only and may differ by one within a run.
    """
    runs: list[Run] = []
    for channel in channels:
        run = next((r for r in runs if _same_run(r, channel)), None)
        if run is None:
            run = Run()
            runs.append(run)
        run.channels.append(channel)
    for power in powers:
        fitting = [r for r in runs if r.power is None and _fits(r, power)]
        run = min(fitting, key=lambda r: apart_s(r.first_packet, power.first_packet)) if fitting else None
        if run is None:
            run = Run()
            runs.append(run)
        elif apart_s(run.first_packet, power.first_packet) > SAME_RUN_S:
            said.flagged.append(
                "a run's power is paired with its samples by ticks and channel, though the report dates them "
                f"{apart_s(run.first_packet, power.first_packet):.0f} s apart"
            )
        run.power = power
    return runs


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
    later_ms = channel.begin_ms - other.begin_ms
    if abs(later_ms) <= SAME_RUN_MS:
        return apart_s(other.first_packet, channel.first_packet) <= SAME_RUN_S
    if other.first_packet is None or channel.first_packet is None:
        return False
    begin, end = max(channel.begin_ms, other.begin_ms), min(channel.end_ms, other.end_ms)
    together = end - begin >= MOSTLY * min(channel.end_ms - channel.begin_ms, other.end_ms - other.begin_ms)
    return together and abs((channel.first_packet - other.first_packet).total_seconds() - later_ms / 1000.0) <= SAME_RUN_S


def _fits(run: Run, power: DevicePower) -> bool:
    """Decide whether power is of the run: of one of its channels, and beginning with it, or within it where the first values were lost."""
    first, last = float(power.ticks_ms[0]) - power.interval_ms, float(power.ticks_ms[-1])
    named = {c.channel for c in run.channels}
    if power.channels and not named & set(power.channels):
        return False
    seconds = apart_s(run.first_packet, power.first_packet)
    if not run.channels[0].ticked:
        return seconds <= SAME_RUN_S
    begin, end = run.span_ms
    later_ms = abs(begin - first)
    if later_ms <= SAME_RUN_MS:
        return True
    # ticks of two runs may cover the same range after the device has restarted them: then the programmer's times differ
    within = min(end, last) - max(begin, first) >= MOSTLY * min(end - begin, last - first)
    return within and seconds <= SAME_RUN_S + later_ms / 1000.0


def apart_s(one: datetime | None, other: datetime | None) -> float:
    """Compute the seconds between two times; 0 where either is unknown."""
    return abs((one - other).total_seconds()) if one and other else 0.0
