"""A session's samples and traces as one file, written in a limited child: samples are decoded anew from the files that came.

The child knows no settings and no database: what it needs stands in its params. `service` beside this is its caller's side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from app.ingest.uploads.compute import options_of
from app.overview.samples.nwb import write_nwb
from app.overview.samples.parquet import write_parquet
from app.overview.samples.signal import Signal
from app.platform.jobs import StepReport
from ml import formats
from ml.formats import SampleLog, UndecodableFile

WRITERS = {"parquet": write_parquet, "nwb": write_nwb}


def write(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Write the file.

    Args:
        params: `format` (of `WRITERS`), `target` and `traces` (paths; traces as `npz`), `headers` of the traces, `files` with their
            `recordings`, and `session`, what the file says of the session.
        workdir: not used.
        report: takes the share that was read.

    Returns:
        `missing`: numbers of recordings that the present decoder does not find in their file; `samples`, how many were written.
    """
    signals: list[Signal] = []
    missing: list[int] = []
    for k, file in enumerate(params["files"]):
        report.progress(k / len(params["files"]), "reading the samples")
        found, lost = _samples(file)
        signals += found
        missing += lost
    samples = sum(s.values.size for s in signals)
    with np.load(params["traces"], allow_pickle=False) as arrays:
        signals += [Signal(**header, t_s=arrays[f"t{i}"], values=arrays[f"v{i}"]) for i, header in enumerate(params["headers"])]
    about = {**params["session"], "recordings_without_samples": missing}
    WRITERS[params["format"]](Path(params["target"]), signals, about)
    return {"missing": missing, "samples": samples}


def _samples(file: Mapping[str, Any]) -> tuple[list[Signal], list[int]]:
    """The samples of a file's recordings within the session as signals, and which recordings it no longer gives."""
    logs, missing = samples_within(file)
    return [
        Signal(row["id"], row["hemisphere"], "lfp", log.channel, log.unit, log.t_s, log.values, log.rates_hz) for row, log in logs
    ], missing


def samples_within(file: Mapping[str, Any]) -> tuple[list[tuple[Mapping[str, Any], SampleLog]], list[int]]:
    """The samples of a file's recordings within the session.

    Args:
        file: as `app.overview.samples.service.files_of` gives it.

    Returns:
        (recording, samples with times from the session's start) per channel, and numbers of the recordings that the present decoder does
        not find in the file.
    """
    wanted: Sequence[Mapping[str, Any]] = file["recordings"]
    try:
        decoded = formats.decode(Path(file["source"]), file["kind"], options_of(file["options"]), name=file["name"]).recordings
    except UndecodableFile:
        return [], [r["id"] for r in wanted]
    by_content = {r.fingerprint: r for r in decoded}
    found = []
    for row in wanted:
        if row["fingerprint"] not in by_content:
            continue
        for log in by_content[row["fingerprint"]].samples:
            here = log.between(row["begin_s"], row["end_s"])
            if here.values.size:
                found.append((row, replace(here, t_s=here.t_s - row["start_s"])))
    return found, [r["id"] for r in wanted if r["fingerprint"] not in by_content]
