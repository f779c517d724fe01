"""Minutes of shaking from the accelerometer or gyroscope of a recording.

Its classes are those of MDS-UPDRS item 3.17, by the largest movement of the hand (Goetz et al., Mov Disord 2008). Slight is up to 1 cm,
mild up to 3 and moderate up to 10 cm, strong beyond. Below 0.1 cm none is counted (ours).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.labs.content import Channel, Content, measured_samples
from ml.formats.labs.fists import open_fists
from ml.formats.labs.meanings import lever_key
from ml.formats.labs.names import TURNS
from ml.formats.recording import FileReport, OutcomeLog
from ml.formats.tables.strivepd import MEASURED, TremorLog
from ml.qoc import TREMOR_CLASSES

Floats = NDArray[np.float64]

TREMOR_HZ = (3.0, 8.0)
MOVEMENT_HZ = (1.0, 15.0)
"""Movement outside is drift of the sensor, or its noise."""
LIMITS_CM = (0.1, 1.0, 3.0, 10.0)
"""Upper limits of none, slight, mild and moderate: largest movement from peak to peak."""
WINDOW_S = 4.0
MINUTE_S = 60.0
RHYTHMIC = 0.5
"""Share of the velocity's power that the band of `TREMOR_HZ` must hold; a window that moves otherwise is of unknown class."""
ACCELERATION = {"m/s2": 1.0, "g": 9.80665}
LEAST_RATE_HZ = 2 * MOVEMENT_HZ[1]


def outcomes_of(content: Content, answers: Mapping[str, Mapping[str, Any]], report: FileReport) -> tuple[OutcomeLog, ...]:
    """Derive outcomes from the motion streams of a recording.

    Args:
        answers: meanings in force, for the lever of a gyroscope.
        report: gets a sentence about each outcome, or about why there is none.
    """
    return (*_tremor(content, answers, report), *open_fists(content, report))


def _tremor(content: Content, answers: Mapping[str, Mapping[str, Any]], report: FileReport) -> Iterator[TremorLog]:
    sensors: dict[tuple[str, int], list[Channel]] = defaultdict(list)
    for channel in content.channels:
        known = ACCELERATION if channel.name.kind == "acceleration" else TURNS if channel.name.kind == "rotation" else {}
        if channel.unit in known and channel.timing.pieces and channel.timing.rate_hz >= LEAST_RATE_HZ:
            sensors[channel.name.kind, channel.group].append(channel)
    kinds = [kind for kind, _ in sensors]
    if not sensors:
        return
    kind = "acceleration" if "acceleration" in kinds else "rotation"
    if kinds.count(kind) > 1:
        report.flagged.append(f"{kinds.count(kind)} sensors of {kind}: no {MEASURED} were derived, for the hand that counts is not stated")
        return
    if not content.clock_known or content.started is None:
        report.flagged.append(f"no {MEASURED} were derived from the motion sensor: the file's clock has no known offset from UTC")
        return
    lever_m = 1.0
    if kind == "rotation":
        stated = answers.get(lever_key(content), {}).get("lever_cm")
        if stated is None:
            report.flagged.append(
                f"no {MEASURED} were derived from the gyroscope: state its distance to the fingertip on the session's page"
            )
            return
        lever_m = float(stated) / 100.0
    axes = next(axes for (name, _), axes in sensors.items() if name == kind)
    found = _minutes(axes, kind, lever_m, content)
    if found is not None:
        minutes = found.start_unix_s.size
        report.understood.append(f"{minutes} {MEASURED} from {len(axes)} axes of {kind}, by the limits of MDS-UPDRS 3.17")
        yield found


def _minutes(axes: list[Channel], kind: str, lever_m: float, content: Content) -> TremorLog | None:
    """Share each minute of a sensor among the classes; what was not measured is unknown. None where it has no whole window."""
    timing = axes[0].timing
    rate, begin = timing.rate_hz, timing.pieces[0].start_s
    scale = {**ACCELERATION, **TURNS}
    signal = np.stack([axis.read() * scale[axis.unit] for axis in axes])
    good = np.all([measured_samples(x) for x in signal], axis=0)
    size = round(WINDOW_S * rate)
    last = timing.span_s[1]
    seconds: dict[int, Floats] = defaultdict(lambda: np.zeros(len(TREMOR_CLASSES)))
    for piece in timing.pieces:
        for at in range(piece.begin, piece.end - size + 1, size):
            if good[at : at + size].all():
                middle = piece.start_s + (at - piece.begin + size / 2) / rate - begin
                seconds[int(middle // MINUTE_S)][classify(signal[:, at : at + size], rate, kind, lever_m)] += WINDOW_S
    if not seconds:
        return None
    count = int(np.ceil((last - begin) / MINUTE_S - 1e-6))
    lengths = np.minimum(MINUTE_S, last - begin - MINUTE_S * np.arange(count))
    shares = np.array([np.minimum(1.0, seconds[i] / lengths[i]) for i in range(count)])
    shares = np.asarray(shares / np.maximum(1.0, shares.sum(axis=1))[:, None], dtype=np.float64)
    shares[:, 0] += 1.0 - shares.sum(axis=1)
    started = content.start_at(begin)
    assert started is not None
    return TremorLog(started.timestamp() + MINUTE_S * np.arange(count, dtype=np.float64), lengths, shares, shares[:, 2:].sum(axis=1))


def classify(window: Floats, rate_hz: float, kind: str, lever_m: float = 1.0) -> int:
    """Classify a window of movement.

    Args:
        window: m/s2, or rad/s of a gyroscope, [axes, n], without gaps.
        kind: `acceleration` or `rotation`. lever_m: from the joint to the fingertip, of a gyroscope.

    Returns:
        The place in `ml.qoc.TREMOR_CLASSES`. A window that moves outside `TREMOR_HZ` more than within it is unknown.
    """
    n = window.shape[1]
    taper = np.hanning(n)
    spectrum = np.fft.rfft((window - window.mean(axis=1, keepdims=True)) * taper, axis=1)
    hz = np.fft.rfftfreq(n, 1.0 / rate_hz)
    moving = (hz >= MOVEMENT_HZ[0]) & (hz <= MOVEMENT_HZ[1])
    inside = (hz >= TREMOR_HZ[0]) & (hz <= TREMOR_HZ[1])
    turn = 2 * np.pi * np.maximum(hz, MOVEMENT_HZ[0])
    velocity = (np.abs(spectrum) ** 2).sum(axis=0) / (turn**2 if kind == "acceleration" else lever_m**-2)
    # mean square of the movement, m2: both halves of the spectrum, the taper's power taken out
    mean_square = float(2 * (velocity / turn**2)[inside].sum() / (n * float((taper**2).sum())))
    peak_to_peak_cm = 100 * 2 * np.sqrt(2 * mean_square)
    total = float(velocity[moving].sum())
    rhythmic = total > 0 and float(velocity[inside].sum()) >= RHYTHMIC * total
    whole_cm = 100 * 2 * np.sqrt(2 * float(2 * (velocity / turn**2)[moving].sum() / (n * float((taper**2).sum()))))
    if whole_cm < LIMITS_CM[0]:
        return 1
    return 1 + int(np.searchsorted(LIMITS_CM, peak_to_peak_cm, side="right")) if rhythmic else 0
