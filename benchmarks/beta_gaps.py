"""Beta amplitude through the gaps of a real recording, on signals whose amplitude without gaps is known.

    python benchmarks/beta_gaps.py [--repeats N] [--seed N] [--quick]

The gaps are those of the montage recording with packet loss (`BETALOOP_TEST_DATA`, else ../shared/data). The signals are made here: a
beta rhythm of 5 Hz bandwidth whose amplitude waxes and wanes, on a background that falls with frequency, and noise. Each is scored whole,
and with the recording's gaps (`ml.signals.band_rows`).

`kept`: share of all rows that a coverage limit keeps. `error_sd`, `bias`: standard deviation and mean of (beta with gaps - beta without)
over the mean beta, of the rows kept. `error_over_se`: standard deviation of the error over the row's own standard error; 1 if exact.
`most_imputed`: how many imputed betas a state of W = 10 may have. `usable`: share of steps whose state and next state are then whole, in
sessions of 100 steps whose rows are valid where the recording's are (patterns in random order). `imputed_error`: RMS error of an imputed
beta over the standard deviation of beta in its session; `state_error`: that of all values of the usable states.
"""

from __future__ import annotations

import argparse
import json
import os
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from support.results import run_benchmark

from ml.formats import DecodeOptions
from ml.formats.rcs.beta import time_domain_stretches
from ml.formats.rcs.packets.scan import batch_of
from ml.formats.rcs.packets.streams import read_time_domain
from ml.formats.rcs.packets.time import reconstruct
from ml.formats.rcs.settings import follow
from ml.signals import band_pass, band_rows
from ml.trajectories import SessionTrajectory

Floats = NDArray[np.float64]
OPTIONS = DecodeOptions()
PERIOD, LOW, HIGH = OPTIONS.period_s, OPTIONS.beta_low_hz, OPTIONS.beta_high_hz
APART_S = 10.0
"""Sensing of one contact pair paused for longer than this: two patterns."""


def recording() -> Path | None:
    """Find the montage recording with packet loss of the test recordings; None, with a line on standard output, where it is absent."""
    folder = Path(os.environ.get("BETALOOP_TEST_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    found = folder / "rcs" / "montage_packet_loss.zip"
    if found.exists():
        return found
    print(f"no recording with packet loss at {found}: set BETALOOP_TEST_DATA to the folder of the test recordings")
    return None


LIMITS = (0.5, 0.6, 0.69, OPTIONS.min_valid_fraction, 0.8)


def gap_patterns(path: Path) -> list[tuple[float, NDArray[np.bool_]]]:
    """Find (rate in Hz, mask of the samples that are there [n]) of each sensing configuration and contact pair, from the packets' own
    times."""
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
    """Make a local field potential: bursts of beta at 17 to 26 Hz in a background of 1/f amplitude and white noise, [n]."""
    hz = np.fft.rfftfreq(n, 1.0 / rate)

    def coloured(amplitude: Floats) -> Floats:
        x = np.fft.irfft(amplitude * (rng.normal(size=hz.size) + 1j * rng.normal(size=hz.size)), n)
        return x / x.std()

    centre = rng.uniform(17.0, 26.0)
    rhythm = band_pass(rng.normal(size=n), rate, centre - 2.5, centre + 2.5)
    waxing = np.exp(0.35 * coloured((hz < 0.3).astype(np.float64)))
    return 1.5 * waxing * rhythm / rhythm.std() + 2.0 * coloured(1.0 / np.maximum(hz, 1.0)) + 0.35 * rng.normal(size=n)


def score_rows(rate: float, there: NDArray[np.bool_], rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Score one signal with one pattern of gaps.

    Returns:
        Coverage, error and standard error of each row, [3, rows], and its beta without gaps, [rows]; all but the first over the mean.
    """
    x = synthetic(there.size, rate, rng)
    rows = round(there.size / rate / PERIOD)
    whole = band_rows([(1.0 / rate, rate, x)], rows, PERIOD, LOW, HIGH).rms
    edges = np.flatnonzero(np.diff(np.concatenate(([0], there.astype(np.int8), [0]))))
    pieces = [((a + 1) / rate, rate, x[a:b]) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
    found, mean = band_rows(pieces, rows, PERIOD, LOW, HIGH), whole.mean()
    return np.stack([found.reached, (found.rms - whole) / mean, found.rms_error / mean]), whole / mean


def figures_at(limit: float, scored: list[tuple[Floats, Floats]]) -> dict[str, float]:
    """Compute the figures of a coverage limit."""
    covered, error, standard = np.concatenate([rows for rows, _ in scored], axis=1)
    kept = (covered >= limit - 1e-9) & np.isfinite(error)
    partly = kept & (standard > 0)
    out = {"kept": float(kept.mean()), "error_sd": float(error[kept].std()), "bias": float(error[kept].mean())}
    return out | ({"error_over_se": float((error[partly] / standard[partly]).std())} if partly.any() else {})


def imputation(scored: list[tuple[Floats, Floats]], rng: np.random.Generator, sessions: int) -> dict[int, dict[str, float]]:
    """Measure what states gain and lose by so many imputed betas, at the default coverage."""
    out = {}
    parts = [(covered >= OPTIONS.min_valid_fraction - 1e-9, whole, whole + error) for (covered, error, _), whole in scored]
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
    parser.add_argument("--seed", type=int, default=0, help="of the signals")
    parser.add_argument("--quick", action="store_true", help="two signals per pattern")
    chosen = parser.parse_args()
    path = recording()
    if path is None:
        return
    rng, patterns = np.random.default_rng(chosen.seed), gap_patterns(path)
    repeats = 2 if chosen.quick else chosen.repeats
    scored = [score_rows(rate, there, rng) for _ in range(repeats) for rate, there in patterns]
    total = sum(whole.size for _, whole in scored)
    seconds = [(there.sum() / rate, there.size / rate) for rate, there in patterns]
    missing = 1.0 - sum(measured for measured, _ in seconds) / sum(whole for _, whole in seconds)
    print(f"{total} rows of {PERIOD:g} s, {len(patterns)} patterns of gaps, {100 * missing:.1f} % of samples missing")
    figures = {limit: figures_at(limit, scored) for limit in LIMITS}
    print(f"{'limit':>6}{'kept, %':>9}{'error SD, %':>13}{'bias, %':>9}{'error/SE':>10}")
    for limit, f in figures.items():
        over = f"{f['error_over_se']:10.2f}" if "error_over_se" in f else ""
        print(f"{limit:>6.2f}{100 * f['kept']:>9.1f}{100 * f['error_sd']:>13.2f}{100 * f['bias']:>9.2f}{over}")
    states = imputation(scored, rng, 40 if chosen.quick else 200)
    print(f"{'most imputed':<13}{'usable, %':>10}{'imputed error, SD':>19}{'state error, SD':>17}")
    for most, s in states.items():
        print(f"{most:<13}{100 * s['usable']:>10.1f}{s['imputed_error']:>19.2f}{s['state_error']:>17.2f}")
    print(json.dumps({"name": "beta_gaps", "figures": figures, "most_imputed": states}))


if __name__ == "__main__":
    run_benchmark(main)
