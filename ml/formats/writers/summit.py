"""Writer of RC+S session folders. Source: public descriptions of the Summit API's JSON files (the open toolbox's documentation)."""

from __future__ import annotations

import io
import json
import math
import zipfile
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from ml.formats.writers.truth import Course, Truth

Json = dict[str, Any]
EPOCH_2000_S = 951_868_800
PLACEHOLDER_MA = 8.5
TICKS_PER_S = 10_000


@dataclass(frozen=True, kw_only=True)
class RcsWorld:
    """One session and what went wrong while it was recorded.

    Attributes:
        began_ms: computer's time of the first sample, ms. seconds: length of the signal.
        changes: (time s, program, mA), ascending; the first of each program at or before 0.
        switches: (time s, on), of therapy. groups: (time s, active group), the first at or before 0.
        programs: that are enabled. cycle: lengths on and off, s, and when a cycle began; None where therapy does not cycle.
        hidden_cycle: whether the lengths are in a unit that no description has.
        tick: of the implant's counter at the first sample. sequence: of the packets' counter. device_s: implant's seconds then.
        drift_ppm: how fast the implant's clock runs. lost: numbers of packets that never came. no_gen: numbers without PacketGenTime.
        packet: samples of one packet. rate: code of the sampling rate (0: 250 Hz, 1: 500 Hz).
        pc_step: (time s, s) by which the computer's clock was set.
        reads: times at which the whole settings were read, s. repeats: whether each change is read again right after it.
        cut: how many bytes of each file remain, by its stem. absent: stems of files that are not there.
        sentinel: number of the change whose logged amplitude is the sign for `hold`.
        utc_offset_h: that the settings state. limit_ma: clinician's highest amplitude.
    """

    began_ms: int
    seconds: float
    changes: tuple[tuple[float, int, float], ...]
    switches: tuple[tuple[float, bool], ...] = ((-1.0, True),)
    groups: tuple[tuple[float, int], ...] = ((-1.0, 0),)
    programs: tuple[int, ...] = (0,)
    cycle: tuple[float, float, float] | None = None
    hidden_cycle: bool = False
    tick: int = 0
    sequence: int = 0
    device_s: int = 700_000_000
    drift_ppm: float = 0.0
    lost: frozenset[int] = frozenset()
    no_gen: frozenset[int] = frozenset()
    packet: int = 50
    rate: int = 1
    pc_step: tuple[float, float] | None = None
    reads: tuple[float, ...] = ()
    repeats: bool = False
    cut: dict[str, int] = field(default_factory=dict)
    absent: frozenset[str] = frozenset()
    sentinel: int | None = None
    utc_offset_h: float = 0.0
    limit_ma: float = 6.0
    seed: int = 0


def write_rcs(world: RcsWorld) -> tuple[bytes, Truth]:
    """Write a session as a zip, and say what was true."""
    rng = np.random.default_rng(world.seed)
    hz = 250 * 2**world.rate
    streams = _time_domain(world, hz, rng)
    log = _stimulation(world)
    settings = _settings(world)
    texts = {
        "RawDataTD": json.dumps([{"RecordInfo": _info(world, 0.0), "TimeDomainData": streams}]),
        "StimLog": json.dumps(log),
        "DeviceSettings": json.dumps(settings),
        "EventLog": "[]",
        "TimeSync": json.dumps([{"RecordInfo": _info(world, 0.0), "TimeSyncData": []}]),
    }
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for stem, text in texts.items():
            if stem not in world.absent:
                archive.writestr(f"Session{world.began_ms}/DeviceNPC700001H/{stem}.json", text[: world.cut.get(stem, len(text))])
    return target.getvalue(), _truth(world, hz, texts)


def _truth(world: RcsWorld, hz: int, texts: dict[str, str]) -> Truth:
    count = int(world.seconds * hz) // world.packet
    there = [k for k in range(count) if k not in world.lost]
    first_s, last_s = there[0] * world.packet / hz, (there[-1] + 1) * world.packet / hz
    courses = {}
    for program in world.programs:
        events = sorted({t for t, *_ in world.changes} | {t for t, _ in world.switches} | {t for t, _ in world.groups})
        levels = [_amplitude_of(world, program, t) for t in events]
        cycle = None if world.cycle is None else (world.cycle[0], world.cycle[1], world.cycle[2] - first_s)
        courses[f"program {program}"] = Course([t - first_s for t in events], levels, cycle)
    began = datetime.fromtimestamp(world.began_ms / 1000.0, UTC) + timedelta(seconds=first_s)
    until = math.inf
    if "StimLog" in world.absent:
        until = -math.inf if not world.reads else max(world.reads) - first_s
    elif "StimLog" in world.cut:
        until = _whole_until(texts["StimLog"], world.cut["StimLog"], _stamps(world)) - first_s
    whole = "DeviceSettings" not in world.absent and world.cut.get("DeviceSettings", math.inf) > _first_length(texts["DeviceSettings"])
    return Truth(0, None, began, last_s - first_s, courses, until, world.cycle is None and whole, True)


def _first_length(text: str) -> int:
    """Measure the first record of a log, characters."""
    return json.JSONDecoder().raw_decode(text, 1)[1]


def _whole_until(text: str, size: int, stamps: list[float]) -> float:
    """Find the time of the last record of the log that is whole within the first bytes; before all time where there is none."""
    if size >= len(text):
        return math.inf
    whole = text[:size].count(', {"RecordInfo"')
    return stamps[whole - 1] if whole else -math.inf


def _level(world: RcsWorld, program: int, t_s: float) -> float:
    """Look up the amplitude that was set, mA."""
    return [ma for t, p, ma in world.changes if p == program and t <= t_s][-1]


def _amplitude_of(world: RcsWorld, program: int, t_s: float) -> float:
    on = [state for t, state in world.switches if t <= t_s][-1]
    group = [g for t, g in world.groups if t <= t_s][-1]
    if not on or group not in (0, 1):
        return 0.0
    return _level(world, program, t_s) if group == 0 else _other_group(program)


def _other_group(program: int) -> float:
    """Give the amplitude of group B, which never changes, mA."""
    return 1.3 + 0.4 * program


def _pc_ms(world: RcsWorld, t_s: float) -> int:
    """Compute what the computer's clock shows, ms."""
    step = world.pc_step[1] if world.pc_step is not None and t_s >= world.pc_step[0] else 0.0
    return round(world.began_ms + 1000.0 * (t_s + step))


def _info(world: RcsWorld, t_s: float) -> Json:
    return {"ApiVer": "1.6.0.0", "DeviceId": "NPC700001H", "HostUnixTime": _pc_ms(world, t_s), "SessionId": str(world.began_ms)}


def _time_domain(world: RcsWorld, hz: int, rng: np.random.Generator) -> list[Json]:
    packets = []
    for k in range(int(world.seconds * hz) // world.packet):
        end_s = (k + 1) * world.packet / hz
        own_s = end_s * (1.0 + 1e-6 * world.drift_ppm)
        ticks = world.tick + round(own_s * TICKS_PER_S)
        t = np.arange(k * world.packet, (k + 1) * world.packet) / hz
        volts = 0.004 * np.sin(2 * np.pi * 20 * t) + 0.002 * rng.standard_normal(t.size)
        if k in world.lost:
            continue
        gen_ms = _pc_ms(world, end_s) + round(rng.normal(0, 8))
        packets.append(
            {
                "Header": {
                    "dataSize": 2 * world.packet,
                    "dataType": 1,
                    "dataTypeSequence": (world.sequence + k) % 256,
                    "globalSequence": (world.sequence + k) % 256,
                    "info": 0,
                    "systemTick": ticks % 65_536,
                    "timestamp": {"seconds": world.device_s + ticks // TICKS_PER_S},
                    "user1": world.rate,
                    "user2": 1,
                },
                "PacketGenTime": -62_135_568_000_000 if k in world.no_gen else gen_ms,
                "PacketRxUnixTime": _pc_ms(world, end_s) + 45 + round(abs(rng.normal(0, 15))),
                "ChannelSamples": [{"Key": 0, "Value": volts.round(6).tolist()}],
                "DebugInfo": 0,
                "EvokedMarker": [],
                "IncludedChannels": 1,
                "SampleRate": world.rate,
                "Units": "millivolts",
            }
        )
    return packets


def _logged_program(amplitude_ma: float) -> Json:
    return {
        "amplitude": round(10 * amplitude_ma),
        "AmplitudeInMilliamps": amplitude_ma,
        "pulseWidth": 6,
        "PulseWidthInMicroseconds": 60,
    }


def _logged_groups(world: RcsWorld, t_s: float) -> Json:
    groups: Json = {}
    for group in range(4):
        programs = {}
        for p in range(4):
            known = p in world.programs and group in (0, 1)
            level = PLACEHOLDER_MA if not known else _level(world, p, t_s) if group == 0 else _other_group(p)
            programs[f"program{p}"] = _logged_program(level)
        groups[f"TherapyConfigGroup{group}"] = {"ratePeriod": 769, "RateInHz": 130.0, **programs}
    return groups


def _stamps(world: RcsWorld) -> list[float]:
    return [t for t, _, _ in _events(world)]


def _events(world: RcsWorld) -> list[tuple[float, str, Json]]:
    """List the records of the log after the first: time, kind, content."""
    found: list[tuple[float, str, Json]] = []
    for number, (t, p, ma) in enumerate(world.changes):
        if t > 0:
            logged = 25.5 if number == world.sentinel else ma
            program = {f"program{p}": {"AmplitudeInMilliamps": logged, "amplitude": round(10 * logged)}}
            found.append((t, "change", {"TherapyConfigGroup0": program}))
            if world.repeats and number != world.sentinel:
                found.append((t + 0.35, "again", {"TherapyConfigGroup0": _logged_groups(world, t + 0.35)["TherapyConfigGroup0"]}))
    found += [(t, "status", {"therapyStatusData": {"therapyStatus": int(on)}}) for t, on in world.switches if t > 0]
    found += [(t, "group", {"therapyStatusData": {"activeGroup": g}}) for t, g in world.groups if t > 0]
    return sorted(found, key=lambda event: event[0])


def _status(world: RcsWorld, t_s: float) -> Json:
    on = [state for t, state in world.switches if t <= t_s][-1]
    return {"activeGroup": [g for t, g in world.groups if t <= t_s][-1], "therapyStatus": int(on)}


def _stimulation(world: RcsWorld) -> list[Json]:
    first = {"RecordInfo": _info(world, -3.0), "therapyStatusData": _status(world, 0.0), **_logged_groups(world, 0.0)}
    return [first, *({"RecordInfo": _info(world, t), **content} for t, _, content in _events(world))]


def _settings_groups(world: RcsWorld, t_s: float) -> Json:
    groups: Json = {}
    for group in range(4):
        programs = []
        for p in range(4):
            known = p in world.programs and group in (0, 1)
            level = PLACEHOLDER_MA if not known else _level(world, p, t_s) if group == 0 else _other_group(p)
            programs.append(
                {
                    "amplitude": round(10 * level),
                    "amplitudeInMilliamps": level,
                    "pulseWidth": 6,
                    "pulseWidthInMicroseconds": 60,
                    "isEnabled": 0 if known else 131,
                }
            )
        unit = 9 if world.hidden_cycle else 2
        on, off = (0.0, 0.0) if world.cycle is None else world.cycle[:2]
        groups[f"TherapyConfigGroup{group}"] = {
            "Index": group,
            "rateInHz": 130.0,
            "ratePeriod": 769,
            "cyclingEnabled": world.cycle is not None,
            "cycleOnTime": {"time": on, "units": unit},
            "cycleOffTime": {"time": off, "units": unit},
            "programs": programs,
        }
    return groups


def _settings(world: RcsWorld) -> list[Json]:
    channel = {"gain": 2, "hpf": 0, "lpf1": 18, "lpf2": 9, "minusInput": 1, "plusInput": 4, "sampleRate": world.rate}
    limits = {
        f"AmplitudeLimitsGroup{g}": {
            key: ma for p in range(4) for key, ma in ((f"prog{p}LowerInMilliamps", 0.0), (f"prog{p}UpperInMilliamps", world.limit_ma))
        }
        for g in range(4)
    }
    first = {
        "RecordInfo": _info(world, -5.0),
        "UtcOffset": world.utc_offset_h,
        "GeneralData": {"therapyStatusData": _status(world, 0.0)},
        "SensingConfig": {
            "timeDomainChannels": [channel, *({**channel, "sampleRate": 240} for _ in range(3))],
            "fftConfig": {"interval": 100, "size": 1, "windowLoad": 2, "bandFormationConfig": 8},
        },
        "SenseState": {"state": 1},
        **_settings_groups(world, 0.0),
        **limits,
    }
    later = [
        {"RecordInfo": _info(world, t), "GeneralData": {"therapyStatusData": _status(world, t)}, **_settings_groups(world, t)}
        for t in sorted(world.reads)
    ]
    return [first, *later]
