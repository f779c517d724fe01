"""Tremor and open fists from the streams of one recording, against movements whose size is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ml.formats import DecodedFile, DecodeOptions, GraspLog, TremorLog, decode, redact
from ml.formats.labs.motion import classify
from ml.qoc import TREMOR_CLASSES
from tests.ml.formats.peers.xdf import Stream, write

RATE = 50.0


def tremor(peak_to_peak_cm: float, hz: float, seconds: float) -> np.ndarray:
    """Make the movement of a point, m, [n]."""
    t = np.arange(round(seconds * RATE)) / RATE
    return peak_to_peak_cm / 200 * np.sin(2 * np.pi * hz * t)


def acceleration(movement: np.ndarray, hz: float) -> np.ndarray:
    """Compute the acceleration of a sinusoidal movement, with gravity along one axis, [n, 3]."""
    along = -((2 * np.pi * hz) ** 2) * movement
    return np.stack([along * 0.8, along * 0.6, np.full(along.size, 9.80665)], axis=1)


def read(path: Path, *streams: Stream, date: str = "2026-03-02T09:00:00+0100", **meanings: object) -> DecodedFile:
    t = np.arange(120 * 250) / 250
    x = 5 * np.sin(2 * np.pi * 20 * t)[:, None] + np.random.default_rng(0).normal(0, 1, (t.size, 1))
    write(path, [Stream("LFP", "LFP", 250.0, 100.0 + t, x, ["LFP L 0-2"], ["uV"]), *streams], date=date)
    redact(path, path.with_suffix(".clean"), "xdf", bytes(32))
    return decode(path.with_suffix(".clean"), "xdf", DecodeOptions(meanings=meanings))  # type: ignore[arg-type]


def motion(values: np.ndarray, labels: list[str], units: list[str], kind: str = "Accelerometer") -> Stream:
    return Stream("IMU", kind, RATE, 100.0 + np.arange(len(values)) / RATE, values, labels, units)


@pytest.mark.parametrize("hz", [4.0, 5.25, 6.9])
@pytest.mark.parametrize(
    ("peak_to_peak_cm", "name"),
    [(0.03, "none"), (0.5, "slight"), (0.9, "slight"), (1.1, "mild"), (2.8, "mild"), (3.3, "moderate"), (11, "strong")],
)
def test_a_rhythmic_movement_has_the_class_of_its_size(peak_to_peak_cm: float, name: str, hz: float) -> None:
    moved = tremor(peak_to_peak_cm, hz, 4.0)
    assert TREMOR_CLASSES[classify(acceleration(moved, hz).T, RATE, "acceleration")] == name
    turned = 2 * np.pi * hz * peak_to_peak_cm / 200 / 0.15 * np.cos(2 * np.pi * hz * np.arange(moved.size) / RATE)
    assert TREMOR_CLASSES[classify(turned[None, :], RATE, "rotation", 0.15)] == name


def test_a_voluntary_movement_is_unknown_and_no_tremor() -> None:
    assert TREMOR_CLASSES[classify(acceleration(tremor(20.0, 2.0, 4.0), 2.0).T, RATE, "acceleration")] == "unknown"


def test_half_a_minute_of_tremor_is_half_a_minute_and_a_gap_is_unknown(tmp_path: Path) -> None:
    moved = acceleration(np.concatenate([tremor(2.0, 5.0, 32.0), np.zeros(round(88 * RATE))]), 5.0)
    sensor = motion(moved + np.random.default_rng(1).normal(0, 0.01, moved.shape), ["acc x", "acc y", "acc z"], ["m/s2"] * 3)
    kept = np.ones(len(moved), dtype=bool)
    kept[round(60 * RATE) : round(90 * RATE)] = False
    sensor.stamps, sensor.values = sensor.stamps[kept], np.asarray(sensor.values)[kept]
    (log,) = read(tmp_path / "a.xdf", sensor).outcomes
    assert isinstance(log, TremorLog)
    assert log.fractions.shape == (2, 6)
    np.testing.assert_allclose(log.fractions.sum(axis=1), 1.0)
    assert log.fractions[0, TREMOR_CLASSES.index("mild")] == pytest.approx(32 / 60, abs=0.01)
    assert log.fractions[1, 0] >= 0.5
    assert log.fractions[1, TREMOR_CLASSES.index("none")] <= 0.5


def test_a_gyroscope_needs_the_length_of_its_lever(tmp_path: Path) -> None:
    hz, t = 5.0, np.arange(round(120 * RATE)) / RATE
    turned = np.degrees(2 * np.pi * hz * 0.01 / 0.15 * np.cos(2 * np.pi * hz * t))[:, None]
    sensor = motion(turned, ["gyro x L"], ["deg/s"], "Gyroscope")
    found = read(tmp_path / "a.xdf", sensor)
    assert found.outcomes == ()
    (question,) = found.recordings[0].quality["questions"]
    assert question["key"] == "gyroscope left"
    (log,) = read(tmp_path / "a.xdf", sensor, **{question["key"]: {"means": "lever", "lever_cm": 15.0}}).outcomes
    assert isinstance(log, TremorLog)
    assert log.fractions[0, TREMOR_CLASSES.index("mild")] == pytest.approx(1.0, abs=0.01)


def test_without_a_known_clock_or_with_two_sensors_no_tremor_is_derived(tmp_path: Path) -> None:
    moved = acceleration(tremor(2.0, 5.0, 120.0), 5.0)
    one = motion(moved, ["acc x", "acc y", "acc z"], ["m/s2"] * 3)
    two = motion(moved, ["acc x", "acc y", "acc z"], ["m/s2"] * 3)
    assert read(tmp_path / "a.xdf", one, date="2026-03-02T09:00:00").outcomes == ()
    found = read(tmp_path / "b.xdf", one, two)
    assert found.outcomes == ()
    assert any("2 sensors" in text for text in found.reports[0].flagged)


def test_the_opening_of_a_hand_gives_its_open_fists(tmp_path: Path) -> None:
    t = np.arange(round(120 * RATE)) / RATE
    testing = (t > 80) & (t < 89.9)
    opening = np.where(testing, 5 + 3 * np.sin(2 * np.pi * 2.5 * t), 2.0) + np.random.default_rng(0).normal(0, 0.02, t.size)
    found = read(tmp_path / "a.xdf", motion(opening[:, None], ["hand opening R"], ["cm"], "Mocap"))
    (log,) = found.outcomes
    assert isinstance(log, GraspLog)
    assert log.hand == "right"
    assert (log.open_fist_s.size - 1) / log.open_fist_s[-1] == pytest.approx(2.5, abs=0.02)
