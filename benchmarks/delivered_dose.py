"""Amplitudes and starts that are wrong and not flagged, in random sessions whose delivered dose and true time are known.

Prints for each device the recordings and steps. Then the steps with a wrong amplitude, and the starts that are wrong by more than 2 s and
not flagged: both must be 0. Then the share that stays usable of the steps that a perfect reader could use: at least 90 %.
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
import zipfile
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from ml.formats import DecodedFile, DecodeOptions, RecordingLog, UndecodableFile, decode, redact, sniff
from ml.formats.writers import PerceptRun, PerceptWorld, RcsWorld, Truth, write_percept, write_rcs

TOLERANCE_MA = 0.06
START_S = 2.0
SLACK_S = {"rcs": (0.1, 0.1), "percept": (0.55, 0.05)}
"""How much earlier and later than it happened a change may be shown, s.

PacketGenTime, by which RC+S logs are placed, wanders by tens of ms. A Percept states the amplitude at the end of every half second, which
covers that whole half second, and its ticks count in 50 ms.
"""
KNOWN_SHARE = DecodeOptions().min_valid_fraction
BEGIN_MS = 1_767_600_000_000


@dataclass
class Score:
    """Counts over sessions.

    Attributes:
        steps: true steps. knowable: those that a perfect reader could know. usable: those with an amplitude, of knowable ones.
        wrong: steps with a wrong amplitude. shifted: starts that are wrong without a word. unreadable: files of no use.
        faults: sentences on what was wrong, with the seed.
    """

    sessions: int = 0
    steps: int = 0
    knowable: int = 0
    usable: int = 0
    wrong: int = 0
    shifted: int = 0
    unreadable: int = 0
    silent: int = 0
    faults: list[str] = field(default_factory=list)


def amplitudes(rng: np.random.Generator, seconds: float, most: float = 4.0) -> list[tuple[float, float]]:
    """Draw a course of amplitudes: (time s, mA), the first before 0, in steps of 0.1 mA."""
    count = int(rng.integers(0, 8))
    times = [-1.0, *np.sort(rng.uniform(1.0, seconds, count)).round(2).tolist()]
    return [(float(t), float(rng.integers(0, int(10 * most)) / 10)) for t in times]


def rcs_world(seed: int) -> RcsWorld:
    """Draw an RC+S session with some faults of the field."""
    rng = np.random.default_rng([1, seed])
    seconds = float(rng.integers(30, 90))
    programs = (0, 1) if rng.random() < 0.2 else (0,)
    changes = [(t, p, ma) for p in programs for t, ma in amplitudes(rng, seconds)]
    changes.sort(key=lambda c: c[0])
    switches, groups = [(-1.0, bool(rng.random() < 0.9))], [(-1.0, int(rng.random() < 0.1))]
    for _ in range(int(rng.integers(0, 3)) * (rng.random() < 0.5)):
        switches.append((round(switches[-1][0] + float(rng.uniform(5, 30)), 2), not switches[-1][1]))
    if rng.random() < 0.25:
        groups.append((round(float(rng.uniform(5, seconds)), 2), 1 - groups[-1][1]))
    packet, rate = int(rng.choice([25, 50, 100])), int(rng.integers(0, 2))
    count = int(seconds * 250 * 2**rate) // packet
    lost: set[int] = set()
    if rng.random() < 0.5:
        lost |= set(np.flatnonzero(rng.random(count) < rng.choice([0.02, 0.15])).tolist())
        if rng.random() < 0.4:
            first = int(rng.integers(0, count))
            lost |= set(range(first, min(count, first + int(rng.integers(10, 300)))))
        lost &= set(range(count - 5))
    no_gen = set(range(int(rng.integers(0, 15)))) if rng.random() < 0.3 else set()
    made: dict[str, Any] = {}
    if rng.random() < 0.15:
        made["cycle"] = (float(rng.choice([5, 10, 60])), float(rng.choice([5, 20, 60])), float(rng.uniform(-60, 0)))
        made["hidden_cycle"] = bool(rng.random() < 0.3)
    if rng.random() < 0.4:
        made["reads"] = tuple(np.sort(rng.uniform(1, seconds, int(rng.integers(1, 4)))).round(2).tolist())
    if rng.random() < 0.15:
        made["pc_step"] = (float(rng.uniform(5, seconds)), float(rng.choice([-30, -3, 3, 10, 3600])))
    if rng.random() < 0.1:
        made["absent"] = frozenset(rng.choice(["StimLog", "DeviceSettings"], 1).tolist())
    later = [k for k, c in enumerate(changes) if c[0] > 0]
    if later and rng.random() < 0.1:
        made["sentinel"] = int(rng.choice(later))
    world = RcsWorld(
        began_ms=BEGIN_MS + int(rng.integers(0, 10**10)),
        seconds=seconds,
        changes=tuple(changes),
        switches=tuple(switches),
        groups=tuple(groups),
        programs=programs,
        tick=int(rng.integers(0, 65_536)),
        sequence=int(rng.integers(0, 256)),
        device_s=int(rng.choice([0, 300_000_000, 800_000_000])),
        drift_ppm=float(rng.normal(0, 60)),
        lost=frozenset(lost),
        no_gen=frozenset(no_gen),
        packet=packet,
        rate=rate,
        repeats=bool(rng.random() < 0.3),
        utc_offset_h=float(rng.choice([0, -8, 5.5, 13])),
        limit_ma=float(rng.choice([4.0, 6.0])),
        seed=seed,
        **made,
    )
    if rng.random() < 0.3:
        content, _ = write_rcs(world)
        stem = str(rng.choice(["StimLog", "StimLog", "DeviceSettings", "RawDataTD"]))
        world = _cut(world, stem, float(rng.uniform(0.02, 1.0)), content)
    return world


def _cut(world: RcsWorld, stem: str, share: float, content: bytes) -> RcsWorld:
    """Cut one file of a session at a share of its bytes."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        sizes = {name.rsplit("/", 1)[1][:-5]: archive.getinfo(name).file_size for name in archive.namelist()}
    return replace(world, cut={stem: int(share * sizes[stem])}) if stem in sizes else world


def percept_world(seed: int) -> PerceptWorld:
    """Draw a visit with a Percept with some faults of the field."""
    rng = np.random.default_rng([2, seed])
    runs, at_s, tick = [], float(rng.uniform(5, 60)), 50 * int(rng.integers(0, 65_536))
    for _ in range(int(rng.integers(1, 4))):
        seconds = int(rng.integers(20, 60))
        sensed = [("left",), ("right",), ("left", "right")][int(rng.integers(0, 3))]
        changes = {s: tuple(amplitudes(rng, seconds)) for s in ("left", "right") if s in sensed or rng.random() < 0.3}
        lost: set[int] = set()
        if rng.random() < 0.4:
            lost = set(np.flatnonzero(rng.random(2 * seconds) < rng.choice([0.03, 0.2])).tolist()) & set(range(2 * seconds - 4))
            lost |= set(range(int(rng.integers(1, 8)))) if rng.random() < 0.3 else set()
        turned = [frozenset(), frozenset({"power"}), frozenset({"samples"}), frozenset({"samples", "power"})][int(rng.integers(0, 4))]
        none = frozenset(np.flatnonzero(rng.random(2 * seconds) < 0.05).tolist()) if rng.random() < 0.3 else frozenset()
        runs.append(
            PerceptRun(
                begin_s=at_s,
                seconds=seconds,
                changes=changes,
                sensed=sensed,
                tick_ms=tick,
                turns=turned,
                lost=frozenset(lost),
                power_late=int(rng.integers(0, 4)) if rng.random() < 0.3 else 0,
                no_power=none,
                no_amplitude=none if rng.random() < 0.3 else frozenset(),
                sizes=[(125,), (62, 63), (63, 62)][int(rng.integers(0, 3))],
            )
        )
        pause = float(rng.choice([3, 30, 600, 3276.8, 4000]))
        at_s += seconds + pause
        tick += 50 * round(20 * (seconds + pause))
    undated = {name for name in ("initial", "final", "begin", "end", "packets") if rng.random() < 0.06}
    return PerceptWorld(
        began=datetime.fromtimestamp(BEGIN_MS / 1000 + int(rng.integers(0, 10**7)), UTC),
        seconds=at_s + float(rng.uniform(10, 300)),
        runs=tuple(runs),
        ahead_s=float(rng.choice([0, 30, 401, 956, 2254, -700, 9000])) + float(rng.uniform(0, 5)),
        drift_s=float(rng.normal(0, 4)),
        cycle=(10.0, 20.0, float(rng.uniform(-60, 0))) if rng.random() < 0.1 else None,
        undated=frozenset(undated),
        zone=float(rng.choice([0, -8, 5.5, 10])),
        written_zone=bool(rng.random() < 0.2),
        shuffled=bool(rng.random() < 0.3) and "packets" not in undated,  # else nothing shows which run is which
        spelling=str(rng.choice(["comma", "bracket", "list"])),
        sentinel=int(rng.choice([4_294_967_295, 2_147_483_647, 65_535])),
        seed=seed,
    )


def read(content: bytes, folder: Path) -> DecodedFile:
    """Clean and decode a file as an upload does."""
    source, clean = folder / "source", folder / "clean"
    source.write_bytes(content)
    kind = sniff(source)
    redact(source, clean, kind, bytes(32))
    return decode(clean, kind)


def judge(kind: str, seed: int, result: DecodedFile, truths: list[Truth], score: Score) -> None:
    """Compare a decoded file with the truth."""
    flags = " ".join(s for r in result.reports for s in (*r.flagged, *r.repaired))
    runs = [r for r in result.recordings if r.run is not None or kind == "rcs"]
    for truth in truths:
        score.sessions += 1
        score.steps += int(truth.length_s // 2)
        if truth.knowable:
            score.knowable += len(truth.courses) * int(min(truth.length_s, max(0.0, truth.known_until_s)) // 2)
        mine = _recording_of(truth, runs, kind)
        if mine is None:
            continue
        _judge_one(kind, seed, mine, truth, flags, score)
        runs.remove(mine)


def _recording_of(truth: Truth, runs: list[RecordingLog], kind: str) -> RecordingLog | None:
    """Find the recording of a truth: of its side, and nearest in time."""
    same = [r for r in runs if kind == "rcs" or r.hemisphere == truth.hemisphere]
    if not same:
        return None
    if any(r.started_at is None for r in same):
        return next((r for r in same if r.run == truth.number), None)
    return min(same, key=lambda r: abs(_off_s(r, truth) - (0.0 if _is_utc(r) else truth.ahead_s)))


def _is_utc(recording: RecordingLog) -> bool:
    """Decide whether the recording claims that its start is in UTC; else it is as its own clock showed it."""
    return bool(recording.settings.get("clock", {}).get("known", True))


def _excused(off_s: float, recording: RecordingLog) -> bool:
    """Decide whether the recording itself says that its start may be off by so much: an unknown clock, or one that was set by that."""
    steps = [by for _, by in recording.quality.get("clock", {}).get("pc_steps", [])] if recording.kind == "rcs" else []
    return not _is_utc(recording) or any(abs(abs(off_s) - abs(by)) <= START_S for by in steps)


def _off_s(recording: RecordingLog, truth: Truth) -> float:
    assert recording.started_at is not None
    return (recording.started_at - truth.began).total_seconds()


def _judge_one(kind: str, seed: int, recording: RecordingLog, truth: Truth, flags: str, score: Score) -> None:
    if recording.started_at is not None:
        off = _off_s(recording, truth)
        clock = recording.settings.get("clock", {})
        within = max(START_S, float(clock.get("uncertainty_s") or 0.0)) if kind == "percept" else START_S
        if abs(off) > within and not _excused(off, recording):
            score.shifted += 1
            score.faults.append(f"{kind} {seed}: start {off:+.1f} s, no word")
    slack = SLACK_S[kind]
    for trace in (t for t in recording.traces if t.stream == "amplitude"):
        course = truth.courses.get(trace.channel) or (next(iter(truth.courses.values())) if len(truth.courses) == 1 else None)
        if course is None:
            score.faults.append(f"{kind} {seed}: trace {trace.channel} of no program")
            continue
        wrong = []
        for end, value, valid in zip(trace.t_end_s.tolist(), trace.values.tolist(), trace.valid.tolist(), strict=True):
            if not valid:
                continue
            low, high = course.means_within(end - trace.dt_s, min(end, truth.length_s), slack, KNOWN_SHARE)
            if low - TOLERANCE_MA <= value <= high + TOLERANCE_MA:
                score.usable += truth.knowable and end <= truth.known_until_s + 1e-6
            else:
                wrong.append(f"{end:.0f} s {value:.2f} for {low:.2f} to {high:.2f}")
        if wrong:
            score.wrong += len(wrong)
            score.faults.append(f"{kind} {seed} {trace.channel}: {len(wrong)} steps wrong, first {wrong[0]}")
        if not trace.valid.any() and "amplitude" not in flags and "stimulation" not in flags:
            score.silent += 1
            score.faults.append(f"{kind} {seed} {trace.channel}: unknown, and no word")


def run(kind: str, seeds: range) -> Score:
    """Score sessions of one kind of device."""
    score = Score()
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            if kind == "rcs":
                content, truth = write_rcs(rcs_world(seed))
                truths = [truth]
            else:
                content, truths = write_percept(percept_world(seed))
            try:
                decoded = read(content, Path(folder))
            except UndecodableFile as error:
                score.unreadable += 1
                score.faults.append(f"{kind} {seed}: {error}")
                continue
            judge(kind, seed, decoded, truths, score)
    return score


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=2000, help="files in all, half of each device")
    parser.add_argument("--seed", type=int, default=0, help="first of the seeds")
    parser.add_argument("--faults", type=int, default=20, help="how many faults are listed")
    parser.add_argument("--quick", action="store_true", help="40 files alone")
    args = parser.parse_args()
    sessions = 40 if args.quick else args.sessions
    for kind in ("rcs", "percept"):
        score = run(kind, range(args.seed, args.seed + sessions // 2))
        share = 100.0 * score.usable / max(1, score.knowable)
        sys.stdout.write(
            f"{kind}: {score.sessions} recordings, {score.steps} steps; silently wrong {score.wrong} steps and {score.shifted} starts, "
            f"unknown without a word {score.silent}; usable {share:.1f} % of {score.knowable} that could be known; "
            f"unreadable {score.unreadable}\n"
        )
        for fault in score.faults[: args.faults]:
            sys.stdout.write(f"  {fault}\n")


if __name__ == "__main__":
    from support.results import run_benchmark

    run_benchmark(main)
