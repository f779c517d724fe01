"""What the screen needs of a session's samples, written once in a limited child: samples, their extremes per bin, the spectrogram.

The child knows no settings and no database. `service` beside this is its caller's side, and reads the folder that is written here.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from app.overview.samples.compute import samples_within
from app.platform.jobs import StepReport
from ml.formats import SampleLog
from ml.sample_views import Stretch, pyramid, spectrogram

HEADER = "channels.json"


def build(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Write the folder `target`: `channels.json`, and for channel i `i-t.npy`, `i-v.npy`, `i-<level>.npy` ([2, bins]) and `i-density.npy`.

    Args:
        params: `target`, and `files` as `app.overview.samples.service.files_of` gives them.
        workdir: not used.
        report: takes the share that was read.

    Returns:
        `channels`, how many there are.
    """
    target = Path(params["target"])
    channels: list[dict[str, Any]] = []
    missing: list[int] = []
    for k, file in enumerate(params["files"]):
        report.progress(k / len(params["files"]), "reading the samples")
        logs, lost = samples_within(file)
        missing += lost
        for row, log in logs:
            channels.append({"recording": row["id"], "hemisphere": row["hemisphere"], **_written(log, target, len(channels))})
    (target / HEADER).write_text(json.dumps({"channels": channels, "missing": missing}))
    return {"channels": len(channels)}


def _written(log: SampleLog, target: Path, number: int) -> dict[str, Any]:
    """Write one channel's arrays; what the header says of it."""
    np.save(target / f"{number}-t.npy", log.t_s)
    np.save(target / f"{number}-v.npy", log.values)
    levels = pyramid(log.t_s, log.values, max(log.rates_hz))
    for k, level in enumerate(levels):
        np.save(target / f"{number}-{k}.npy", np.stack([level.low, level.high]))
    begin, end = float(log.t_s.min()), float(log.t_s.max())
    power = spectrogram(_stretches(log), begin, end)
    np.save(target / f"{number}-density.npy", power.density)
    return {
        "channel": log.channel,
        "unit": log.unit,
        "rates_hz": list(log.rates_hz),
        "samples": int(log.values.size),
        "begin_s": begin,
        "end_s": end,
        "widths_s": [level.width_s for level in levels],
        "column_s": power.width_s,
        "hz": power.hz.tolist(),
    }


def _stretches(log: SampleLog) -> Iterator[Stretch]:
    """Gap-free pieces with the rate that their own times have."""
    for first, stop in zip(log.starts, [*log.starts[1:], log.values.size], strict=True):
        if stop - first > 1:
            rate = (stop - first - 1) / (log.t_s[stop - 1] - log.t_s[first])
            nominal = min(log.rates_hz, key=lambda r: abs(r - rate))
            yield float(log.t_s[first]), float(nominal), log.values[first:stop]
