"""Writer of Percept session reports. Source: public descriptions of the programmer's JSON (Medtronic's published loop, open toolboxes)."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from ml.formats.writers.truth import Course, Truth

Json = dict[str, Any]
TURN_MS = 65_536 * 50
RATE_HZ = 250
CHANNELS = {"left": "ZERO_TWO_LEFT", "right": "ONE_THREE_RIGHT"}


@dataclass(frozen=True, kw_only=True)
class PerceptRun:
    """One streaming run.

    Attributes:
        begin_s: from the begin of the session to the first sample. seconds: length, whole.
        changes: by side, (time s, mA) ascending, the first at or before 0; a side that is not there is not stimulated.
        sensed: sides with samples and power.
        tick_ms: of the counter at the first sample, a multiple of 50.
        turns: which series count modulo their turn: any of `samples`, `power`.
        lost: numbers of half-second packets that never came. power_late: values of the power that are missing at the begin.
        no_power: numbers of values of the power with the sign for no reading. no_amplitude: the same of the amplitude.
        sizes: samples of the packets in turn, such as (125,) or (62, 63).
    """

    begin_s: float
    seconds: int
    changes: dict[str, tuple[tuple[float, float], ...]]
    sensed: tuple[str, ...] = ("left",)
    tick_ms: int = 100_000
    turns: frozenset[str] = frozenset()
    lost: frozenset[int] = frozenset()
    power_late: int = 0
    no_power: frozenset[int] = frozenset()
    no_amplitude: frozenset[int] = frozenset()
    sizes: tuple[int, ...] = (125,)


@dataclass(frozen=True, kw_only=True)
class PerceptWorld:
    """One visit with the programmer.

    Attributes:
        began: UTC of the session's begin. seconds: its length. runs: in it.
        ahead_s: of the implant's clock at the begin. drift_s: how much more at the end.
        cycle: lengths on and off, and begin in s of the session; None where the group does not cycle.
        undated: which dates are missing: any of `initial`, `final`, `begin`, `end`, `packets`.
        zone: of the programmer, hours; written_zone: whether dates carry it instead of `Z`.
        shuffled: whether the entries of a section are in another order than they began.
        spelling: of packet lists.
    """

    began: datetime
    seconds: float
    runs: tuple[PerceptRun, ...]
    ahead_s: float = 0.0
    drift_s: float = 0.0
    cycle: tuple[float, float, float] | None = None
    undated: frozenset[str] = frozenset()
    zone: float = 0.0
    written_zone: bool = False
    shuffled: bool = False
    spelling: str = "comma"
    sentinel: int = 4_294_967_295
    seed: int = 0
    extra: Json = field(default_factory=dict)


def write_percept(world: PerceptWorld) -> tuple[bytes, list[Truth]]:
    """Write a report, and say what was true of each run and side."""
    rng = np.random.default_rng(world.seed)
    domains, powers, truths = [], [], []
    for number, run in enumerate(world.runs):
        domains += [_samples(world, run, side, rng) for side in run.sensed]
        powers.append(_power(world, run, rng))
        truths += [_truth(world, run, number, side) for side in ("left", "right") if side in run.changes or side in run.sensed]
    if world.shuffled:
        domains = [domains[i] for i in rng.permutation(len(domains))]
        powers = [powers[i] for i in rng.permutation(len(powers))]
    ends = {"initial": 0.0, "final": world.seconds}
    part: dict[str, Json] = {
        name.capitalize(): {"Neurostimulator": "Percept PC", "NeurostimulatorSerialNumber": "NPX700001H"}
        | ({} if name in world.undated else {"DeviceDateTime": _implant_date(world, t)})
        for name, t in ends.items()
    }
    cycling: Json = {"Enabled": world.cycle is not None}
    if world.cycle is not None:
        cycling |= {"OnDurationInMilliSeconds": 1000 * world.cycle[0], "OffDurationInMilliSeconds": 1000 * world.cycle[1]}
    groups = [
        {"GroupId": "GroupIdDef.GROUP_A", "ActiveGroup": True, "GroupSettings": {"Cycling": cycling}, "ProgramSettings": {}},
        {"GroupId": "GroupIdDef.GROUP_B", "ActiveGroup": False, "GroupSettings": {"Cycling": {"Enabled": False}}, "ProgramSettings": {}},
    ]
    report: Json = {
        "AbnormalEnd": False,
        "ProgrammerUtcOffset": f"{'-' if world.zone < 0 else '+'}{int(abs(world.zone)):02d}:{round(60 * (abs(world.zone) % 1)):02d}",
        "DeviceInformation": part,
        "LeadConfiguration": {
            "Final": [{"Hemisphere": f"HemisphereLocationDef.{s.capitalize()}", "LeadLocation": "LeadLocationDef.Stn"} for s in CHANNELS]
        },
        "Groups": {"Initial": groups, "Final": groups},
        "BrainSenseTimeDomain": domains,
        "BrainSenseLfp": powers if len(powers) > 1 else powers[0],
        **world.extra,
    }
    if "begin" not in world.undated:
        report["SessionDate"] = _date(world, world.began)
    if "end" not in world.undated:
        report["SessionEndDate"] = _date(world, world.began + timedelta(seconds=world.seconds))
    return json.dumps(report).encode(), truths


def _date(world: PerceptWorld, utc: datetime) -> str:
    if not world.written_zone:
        return utc.strftime("%Y-%m-%dT%H:%M:%SZ")
    local = utc + timedelta(hours=world.zone)
    sign = "-" if world.zone < 0 else "+"
    return f"{local:%Y-%m-%dT%H:%M:%S}{sign}{int(abs(world.zone)):02d}:{round(60 * (abs(world.zone) % 1)):02d}"


def _implant_date(world: PerceptWorld, t_s: float) -> str:
    """Write what the implant's clock shows so long after the session's begin, to the second."""
    ahead = world.ahead_s + world.drift_s * t_s / world.seconds
    return (world.began + timedelta(seconds=math.floor(t_s + ahead))).strftime("%Y-%m-%dT%H:%M:%SZ")


def _first(run: PerceptRun) -> int:
    """Find the number of the first half second of which anything came."""
    if not run.sensed:
        return run.power_late
    return min(next(k for k in range(2 * run.seconds) if k not in run.lost), run.power_late)


def _truth(world: PerceptWorld, run: PerceptRun, number: int, side: str) -> Truth:
    first_s = 0.5 * _first(run)
    changes = run.changes.get(side, ((-1.0, 0.0),))
    cycle = None
    if world.cycle is not None:
        cycle = (world.cycle[0], world.cycle[1], world.cycle[2] - run.begin_s - first_s)
    course = Course([t - first_s for t, _ in changes], [ma for _, ma in changes], cycle)
    both = ("initial" not in world.undated and "begin" not in world.undated) or (
        "final" not in world.undated and "end" not in world.undated
    )
    return Truth(
        number,
        side,
        world.began + timedelta(seconds=run.begin_s + first_s),
        run.seconds - first_s,
        {side: course},
        math.inf,
        world.cycle is None,
        both and "packets" not in world.undated,
        world.ahead_s + world.drift_s * run.begin_s / world.seconds,
    )


def _samples(world: PerceptWorld, run: PerceptRun, side: str, rng: np.random.Generator) -> Json:
    t = np.arange(run.seconds * RATE_HZ) / RATE_HZ
    values = 3.0 * np.sin(2 * np.pi * 20 * t) + rng.standard_normal(t.size)
    sizes, ticks, kept, begin, turn = [], [], [], 0, 0
    while begin < t.size:
        size = min(run.sizes[turn % len(run.sizes)], t.size - begin)
        end_ms = 1000 * (begin + size) // RATE_HZ
        if begin * 2 // RATE_HZ not in run.lost:
            sizes.append(size)
            ticks.append(_tick_of(run, "samples", end_ms))
            kept.append(values[begin : begin + size])
        begin, turn = begin + size, turn + 1
    sequences = [k % 256 for k in range(len(sizes))]
    first = next(k for k in range(2 * run.seconds) if k not in run.lost)
    return {
        "Pass": "",
        "GlobalSequences": _list_of(world, sequences),
        "GlobalPacketSizes": _list_of(world, sizes),
        "TicksInMses": _list_of(world, ticks),
        "Channel": CHANNELS[side],
        "Gain": 227,
        "FirstPacketDateTime": "" if "packets" in world.undated else _implant_date(world, run.begin_s + 0.5 * first),
        "SampleRateInHz": RATE_HZ,
        "TimeDomainData": np.concatenate(kept).round(6).tolist(),
    }


def _list_of(world: PerceptWorld, numbers: list[int]) -> str | list[int]:
    """Write a list of packets as one of the versions of the programmer does."""
    if world.spelling == "comma":
        return ",".join(map(str, numbers)) + ","
    return str(numbers) if world.spelling == "bracket" else numbers


def _tick_of(run: PerceptRun, series: str, end_ms: float) -> int:
    """Compute a tick at the resolution of the counter, 50 ms."""
    tick = run.tick_ms + 50 * round(end_ms / 50)
    return tick % TURN_MS if series in run.turns else tick


def _power(world: PerceptWorld, run: PerceptRun, rng: np.random.Generator) -> Json:
    rows = []
    for k in range(run.power_late, 2 * run.seconds - 1):
        row: Json = {"Seq": k % 256, "TicksInMs": _tick_of(run, "power", 500 * (k + 1)), "StatusBytes": "00 00 00 00"}
        for side in ("left", "right"):
            changes = run.changes.get(side, ((-1.0, 0.0),))
            level = [ma for t, ma in changes if t <= 0.5 * (k + 1)][-1]
            power = world.sentinel if k in run.no_power else int(rng.integers(300, 900))
            row[side.capitalize()] = {
                "LFP": power if side in run.sensed else 0,
                "mA": 25.5 if k in run.no_amplitude else level,
            }
        rows.append(row)
    snapshot: Json = {"ActiveGroup": "GroupIdDef.GROUP_A"}
    for side in run.sensed:
        snapshot[side.capitalize()] = {
            "FrequencyInHertz": 20.51,
            "RateInHertz": 125,
            "UpperLimitInMilliAmps": 5.0,
            "LowerLimitInMilliAmps": 0.0,
        }
    return {
        "Channel": ",".join(CHANNELS[s] for s in run.sensed),
        "FirstPacketDateTime": "" if "packets" in world.undated else _implant_date(world, run.begin_s + 0.5 * run.power_late),
        "SampleRateInHz": 2,
        "TherapySnapshot": snapshot,
        "LfpData": rows,
    }
