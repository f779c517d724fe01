"""Comparison of a decoded recording with what is known of it: nothing may be wrong without a word, and little may be lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ml.formats.recording import RecordingLog
from ml.signals import step_means
from tests.ml.formats.peers.truth import Truth

PERIOD_S = 2.0


@dataclass(frozen=True)
class Outcome:
    """Counts of one file.

    Attributes:
        wrong_samples: values that are not within one period of their true time. wrong_steps: amplitudes that differ by 0.05 mA or more.
        samples, steps: of a perfect reader. found_samples, known_steps: of them, what was decoded.
    """

    wrong_samples: int
    wrong_steps: int
    samples: int
    found_samples: int
    steps: int
    known_steps: int


def compare(
    recordings: Sequence[RecordingLog],
    truth: Truth,
    names: dict[str, str],
    lsb_uv: float = 0.0,
    known_until_s: float | None = None,
    pause: bool = False,
    steps: list[tuple[float, float]] | None = None,
) -> Outcome:
    """Compare recordings, decoded with their samples, with the truth.

    Args:
        names: the decoded name of each true channel.
        lsb_uv: resolution of the file.
        known_until_s: until when the file has marks.
        pause: whether a gap loses marks too. A perfect reader then knows no amplitude from each gap to the next mark.
        steps: what a perfect reader knows, where that is not the truth's steps: (time, mA or NaN).
    """
    logs = {s.channel: s for r in recordings for s in r.samples}
    first = truth.t_s[0] - 1.0 / truth.rate_hz
    wrong = found = 0
    for name, x in truth.channels.items():
        log = logs.get(names[name])
        if log is None:
            continue
        at = np.rint((log.t_s + first - truth.t_s[0]) * truth.rate_hz).astype(int)
        place = np.full(truth.total + 3, -1)
        place[np.rint((truth.t_s - truth.t_s[0]) * truth.rate_hz).astype(int) + 1] = np.arange(truth.t_s.size)
        ok = np.zeros(at.size, dtype=bool)
        tolerance = 0.51 * lsb_uv + 2e-6 * max(1.0, float(np.max(np.abs(x))))
        for by in (0, -1, 1):
            index = place[np.clip(at + by + 1, 0, truth.total + 2)]
            ok |= (index >= 0) & (np.abs(log.values - x[np.maximum(index, 0)]) <= tolerance)
        wrong += int((~ok).sum())
        found += int(ok.sum())
    rows = max(t.values.size for r in recordings for t in r.traces)
    knots = list(truth.steps if steps is None else steps)
    if pause:
        knots += [(float(truth.t_s[b - 1]) + 1 / truth.rate_hz, float("nan")) for _, b in truth.pieces()[:-1]]
    if known_until_s is not None:
        knots.append((known_until_s, float("nan")))
    knots.sort(key=lambda k: k[0])
    t, a = (np.array(v, dtype=float) for v in zip(*knots, strict=True)) if knots else (np.empty(0), np.empty(0))
    perfect, share = step_means(t - first, a, rows * PERIOD_S, rows, PERIOD_S)
    known = share >= 0.7
    wrong_steps = known_steps = 0
    for recording in recordings:
        for trace in recording.traces:
            if trace.stream == "amplitude":
                differs = trace.valid & ~(np.abs(trace.values - perfect) < 0.05)
                wrong_steps += int(differs.sum())
                known_steps += int((trace.valid & known & ~differs).sum())
    return Outcome(wrong, wrong_steps, truth.t_s.size * len(truth.channels), found, int(known.sum()) * len(recordings), known_steps)
