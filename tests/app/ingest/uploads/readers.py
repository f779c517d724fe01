"""Replacements of the real readers in children of the tests: `monkeypatch.setattr(reading, "DECODE", f"{readers.__name__}:kill")`."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np

from app.ingest.uploads import compute
from app.platform.jobs import StepReport
from app.platform.raw_bytes import RawFile
from tests.app.ingest.safety.planted import NOTE, WHO


def kill(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Kill the process, as a machine without memory does."""
    os.kill(os.getpid(), signal.SIGKILL)
    return {}


def kill_once(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Kill the process the first time, decode the second."""
    been = Path(params["source"]).with_name("been")
    if been.exists():
        return compute.decode(params, workdir, report)
    been.touch()
    return kill(params, workdir, report)


def full(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Write to a disk that is full."""
    Path("/dev/full").write_bytes(b"decoded")
    return {}


def outgrow(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Ask for 64 GiB, as a number in a file may request."""
    return {"sum": float(np.ones(1 << 33).sum())}


def spin(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Run without an end."""
    while True:
        pass


def sleep(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Report a share, and stay."""
    report.progress(0.25, "decoding")
    report.flush()
    time.sleep(600)
    return {}


def hold(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Report a share, and decode on a signal."""
    report.progress(0.25, "decoding")
    report.flush()
    while not Path(params["source"]).with_name("go").exists():
        time.sleep(0.05)
    return compute.decode(params, workdir, report)


def fault_of_rcs(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Fail, as a decoder with a fault of ours does, and quote the file in the error."""
    if params["kind"] == "rcs":
        raise ZeroDivisionError("a fault of ours, in the file of Ada Lovelace")
    return compute.decode(params, workdir, report)


def fault_of_cleaning(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Fail with half of the file written, unless it is a table."""
    path, key = params["source"]
    with RawFile(Path(path), Path(key)).open() as source:
        if source.read(4) == b"PK\x03\x04":
            Path(params["target"]).write_bytes(b"SYN000001H, half cleaned")
            raise ZeroDivisionError("a fault of ours, in the file of Ada Lovelace")
    return compute.clean(params, workdir, report)


def fault_that_quotes(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Fail with an error that quotes the whole file, as errors of libraries do."""
    return {"number": float(WHO + NOTE)}
