"""Gaps of a real recording on signals whose beta without gaps is known: what the benchmarks of beta through gaps share."""

from __future__ import annotations

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

Floats = NDArray[np.float64]
OPTIONS = DecodeOptions()
PERIOD, LOW, HIGH = OPTIONS.period_s, OPTIONS.beta_low_hz, OPTIONS.beta_high_hz
APART_S = 10.0
"""Sensing of one contact pair paused for longer than this: two patterns."""


def recording() -> Path | None:
    """The montage recording with packet loss of the test recordings; None, said on standard output, where it is not there."""
    folder = Path(os.environ.get("BETALOOP_TEST_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
    found = folder / "rcs" / "montage_packet_loss.zip"
    if found.exists():
        return found
    print(f"no recording with packet loss at {found}: set BETALOOP_TEST_DATA to the folder of the test recordings")
    return None


def scored(path: Path, repeats: int, rng: np.random.Generator) -> tuple[Rule, Rule, int]:
    """Signals with the recording's gaps by the present and by the former rule, so many per pattern; and how many patterns it has."""
    patterns, present, former = gap_patterns(path), Rule(), Rule()
    for _ in range(repeats):
        for rate, there in patterns:
            score(rate, there, rng, present, former)
    return present, former, len(patterns)


@dataclass
class Rule:
    """What a rule made of all rows so far: coverage (the present rule's within a sample),
    error over the mean, standard error over the mean; and the CPU it took."""

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
    present.rows.append(np.stack([found.reached, (found.rms - whole) / mean, found.rms_error / mean]))
    present.whole.append(whole / mean)
    former.rows.append(np.stack([covered, (rms - whole) / mean, np.zeros(rows)]))
