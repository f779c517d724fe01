"""Beta amplitude through the gaps of a real recording, on signals whose amplitude without gaps is known.

    python benchmarks/beta_gaps.py [--repeats N] [--quick]

The gaps are those of the montage recording with packet loss (`BETALOOP_TEST_DATA`, else ../shared/data); the signals are made here: a
beta rhythm of 5 Hz bandwidth whose amplitude waxes and wanes, on a background that falls with frequency, and noise. Each is scored whole,
and with the recording's gaps by two rules: `present` (`ml.signals.band_rows`: interpolated for the filter, measured samples scored) and
`former` (every gap-free stretch filtered by itself, short ones left out).

`kept`: share of all rows that a coverage limit keeps. `error_sd`, `bias`: standard deviation and mean of (beta with gaps - beta without)
over the mean beta, of the rows kept. `error_over_se`: standard deviation of the error over the row's own standard error; 1 if exact.
`most_imputed`: how many imputed betas a state of W = 10 may hold. `usable`: share of steps whose state and next state are then whole, in
sessions of 100 steps whose rows are valid where the recording's are (patterns in random order); `imputed_error`: RMS error of an imputed
beta over the standard deviation of beta in its session; `state_error`: that of all values of the usable states.
`cpu_ratio`: CPU seconds of the present rule over those of the former one.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats import DecodeOptions
from ml.formats.rcs.beta import time_domain_stretches
from ml.formats.rcs.packets.scan import batch_of
from ml.formats.rcs.packets.streams import read_time_domain
from ml.formats.rcs.packets.time import reconstruct
from ml.formats.rcs.settings import follow
from ml.signals import MIN_CYCLES, Stretch, band_pass, band_rows, row_of
from ml.trajectories import SessionTrajectory

Floats = NDArray[np.float64]
OPTIONS = DecodeOptions()
PERIOD, LOW, HIGH = OPTIONS.period_s, OPTIONS.beta_low_hz, OPTIONS.beta_high_hz
LIMITS = (0.5, 0.6, OPTIONS.min_valid_fraction, 0.8)
APART_S = 10.0
"""Sensing of one contact pair paused for longer than this: two patterns."""


@dataclass
class Rule:
    """What a rule made of all rows so far: coverage, error over the mean, standard error over the mean; and the CPU it took."""

    rows: list[Floats] = field(default_factory=list)
    cpu_s: float = 0.0
    whole: list[Floats] = field(default_factory=list)

    def betas(self) -> Iterator[tuple[Floats, Floats]]:
        """Rows of each signal, and its beta without gaps; both over the mean."""
        return zip(self.rows, self.whole, strict=True)

    def at(self, limit: float) -> dict[str, float]:
        """Figures of a coverage limit."""
        covered, error, standard = np.concatenate(self.rows, axis=1)
        kept = (covered >= limit - 1e-9) & np.isfinite(error)
        partly = kept & (standard > 0)
        out = {"kept": float(kept.mean()), "error_sd": float(error[kept].std()), "bias": float(error[kept].mean())}
        return out | ({"error_over_se": float((error[partly] / standard[partly]).std())} if partly.any() else {})


def gap_patterns(path: Path) -> list[tuple[float, NDArray[np.bool_]]]:
    """(rate in Hz, which samples are there [n]) of each sensing configuration and contact pair, from the packets' own times."""
    with zipfile.ZipFile(path) as archive:
        named = {PurePosixPath(name).stem: json.loads(archive.read(name)) for name in archive.namelist() if name.endswith(".json")}
    packets: list[Any] = [packet for element in named["RawDataTD"] for packet in element["TimeDomainData"]]
    data = read_time_domain(iter([batch_of(packets)]))
    channels = time_domain_stretches(data, reconstruct(data.headers), follow(named["DeviceSettings"], named["StimLog"]))
    out = []
    for pieces in channels.values():
        for rate in sorted({rate for _, rate, _ in pieces}):
            begin = np.array([start / 1000.0 for start, r, _ in sorted(pieces, key=lambda p: p[0]) if r == rate])
            size = np.array([x.size for _, r, x in sorted(pieces, key=lambda p: p[0]) if r == rate])
            cuts = np.flatnonzero(np.diff(begin) - size[:-1] / rate > APART_S) + 1
            for own in np.split(np.arange(begin.size), cuts):
                first = np.rint((begin[own] - begin[own[0]]) * rate).astype(int)
                there = np.zeros(first[-1] + size[own[-1]], dtype=bool)
                for a, n in zip(first.tolist(), size[own].tolist(), strict=True):
                    there[a : a + n] = True
                whole = int(there.size / rate / PERIOD) * round(PERIOD * rate)
                out.append((rate, there[:whole]))
    return out


def synthetic(n: int, rate: float, rng: np.random.Generator) -> Floats:
    """A local field potential: bursts of beta at 17 to 26 Hz in a background of 1/f amplitude and white noise, [n]."""
    hz = np.fft.rfftfreq(n, 1.0 / rate)

    def coloured(amplitude: Floats) -> Floats:
        x = np.fft.irfft(amplitude * (rng.normal(size=hz.size) + 1j * rng.normal(size=hz.size)), n)
        return x / x.std()

    centre = rng.uniform(17.0, 26.0)
    rhythm = band_pass(rng.normal(size=n), rate, centre - 2.5, centre + 2.5)
    waxing = np.exp(0.35 * coloured((hz < 0.3).astype(np.float64)))
    return 1.5 * waxing * rhythm / rhythm.std() + 2.0 * coloured(1.0 / np.maximum(hz, 1.0)) + 0.35 * rng.normal(size=n)


def former_rule(pieces: list[Stretch], rows: int) -> tuple[Floats, Floats]:
    """RMS and coverage per row with every gap-free stretch filtered by itself, as up to decode version 3."""
    energy, seconds = np.zeros(rows), np.zeros(rows)
    for start_s, rate, x in pieces:
        if x.size >= MIN_CYCLES * rate / LOW:
            row = np.minimum(row_of(start_s + np.arange(x.size) / rate, PERIOD), rows - 1)
            energy += np.bincount(row, weights=band_pass(x, rate, LOW, HIGH) ** 2, minlength=rows) / rate
            seconds += np.bincount(row, minlength=rows) / rate
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(energy / seconds), seconds / PERIOD


def score(rate: float, there: NDArray[np.bool_], rng: np.random.Generator, present: Rule, former: Rule) -> None:
    """One signal with one pattern of gaps, by both rules."""
    x = synthetic(there.size, rate, rng)
    rows = round(there.size / rate / PERIOD)
    whole = band_rows([(1.0 / rate, rate, x)], rows, PERIOD, LOW, HIGH).rms
    edges = np.flatnonzero(np.diff(np.concatenate(([0], there.astype(np.int8), [0]))))
    pieces = [((a + 1) / rate, rate, x[a:b]) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
    began = time.process_time()
    found = band_rows(pieces, rows, PERIOD, LOW, HIGH)
    between = time.process_time()
    rms, covered = former_rule(pieces, rows)
    former.cpu_s += time.process_time() - between
    present.cpu_s += between - began
    mean = whole.mean()
    present.rows.append(np.stack([found.covered, (found.rms - whole) / mean, found.rms_error / mean]))
    present.whole.append(whole / mean)
    former.rows.append(np.stack([covered, (rms - whole) / mean, np.zeros(rows)]))


def imputation(present: Rule, rng: np.random.Generator, sessions: int) -> dict[int, dict[str, float]]:
    """What states gain and lose by so many imputed betas, at the default coverage."""
    out = {}
    parts = [(covered >= OPTIONS.min_valid_fraction - 1e-9, whole, whole + error) for (covered, error, _), whole in present.betas()]
    drawn = [[parts[i] for i in rng.integers(len(parts), size=8)] for _ in range(sessions)]
    for most in (0, 1, 2, 3, 4):
        usable, squares, imputed = [], [], []
        for chosen in drawn:
            valid, whole, seen = (np.concatenate(x)[:110] for x in zip(*chosen, strict=True))
            seen = np.where(valid, seen, np.nan)
            s = SessionTrajectory(1, 1, "other", seen[:10], seen[10:], np.zeros(seen.size - 10), most_imputed=most)
            spread = float(np.std(whole))
            usable.append(s.usable().mean())
            error = (s.padded_beta - whole) / spread
            imputed.append(error[s.imputed] ** 2)
            squares.append(np.lib.stride_tricks.sliding_window_view(error, 10)[:-1][s.usable()].ravel() ** 2)
        errors = np.concatenate(imputed)
        out[most] = {
            "usable": float(np.mean(usable)),
            "imputed_error": float(np.sqrt(errors.mean())) if errors.size else 0.0,
            "state_error": float(np.sqrt(np.concatenate(squares).mean())),
        }
    return out


def main() -> None:
    """Print a table and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=20, help="signals per pattern of gaps")
    parser.add_argument("--quick", action="store_true", help="two signals per pattern")
    chosen = parser.parse_args()
    folder = Path(os.environ.get("BETALOOP_TEST_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    recording = folder / "rcs" / "montage_packet_loss.zip"
    if not recording.exists():
        print(f"no recording with packet loss at {recording}: set BETALOOP_TEST_DATA to the folder of the test recordings")
        return
    patterns = gap_patterns(recording)
    rng, present, former = np.random.default_rng(0), Rule(), Rule()
    for _ in range(2 if chosen.quick else chosen.repeats):
        for rate, there in patterns:
            score(rate, there, rng, present, former)
    total = sum(rows.shape[1] for rows in present.rows)
    missing = 1.0 - np.concatenate(present.rows, axis=1)[0].mean()
    print(f"{total} rows of {PERIOD:g} s, {len(patterns)} patterns of gaps, {100 * missing:.1f} % of samples missing")
    figures = {name: {limit: rule.at(limit) for limit in LIMITS} for name, rule in (("present", present), ("former", former))}
    print(f"{'rule':<9}{'limit':>6}{'kept, %':>9}{'error SD, %':>13}{'bias, %':>9}{'error/SE':>10}")
    for name, by_limit in figures.items():
        for limit, f in by_limit.items():
            over = f"{f['error_over_se']:10.2f}" if "error_over_se" in f else ""
            print(f"{name:<9}{limit:>6.2f}{100 * f['kept']:>9.1f}{100 * f['error_sd']:>13.2f}{100 * f['bias']:>9.2f}{over}")
    states = imputation(present, rng, 40 if chosen.quick else 200)
    print(f"{'most imputed':<13}{'usable, %':>10}{'imputed error, SD':>19}{'state error, SD':>17}")
    for most, s in states.items():
        print(f"{most:<13}{100 * s['usable']:>10.1f}{s['imputed_error']:>19.2f}{s['state_error']:>17.2f}")
    now, before = (figures[name][OPTIONS.min_valid_fraction] for name in ("present", "former"))
    ratios = {
        "kept": now["kept"] / before["kept"],
        "error_sd": now["error_sd"] / before["error_sd"],
        "cpu_ratio": present.cpu_s / former.cpu_s,
    }
    print(json.dumps({"name": "beta_gaps", "figures": figures, "most_imputed": states, "ratios": ratios}))


if __name__ == "__main__":
    main()
