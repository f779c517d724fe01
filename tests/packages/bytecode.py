"""Bytecode of what betaloop, its jobs and its tests load, written once at their installation.

Two thirds of the packages' modules are never imported, so that the installation compiles none. Each is compiled when it is first imported,
and kept where Python may write. It is not kept where PYTHONDONTWRITEBYTECODE is set, nor where the service's user does not own the
packages. There every start would compile two thousand modules: three to five seconds of the processor.
"""

from __future__ import annotations

import py_compile
import sys
import time
from importlib import import_module
from importlib.util import cache_from_source
from pathlib import Path

LOADED = (
    "app.cli",
    "app.main:create_app",
    "app.platform.jobs.worker",
    "app.ingest.uploads.compute:prepare",
    "app.learning.foreign",
    "app.learning.training_compute:prepare",
    "app.evaluation.estimates.compute:prepare",
    "uvicorn.protocols.http.auto",
    "uvicorn.loops.auto",
    "uvicorn.lifespan.on",
    "onnxruntime",
    "fpdf",
)
"""Modules, and functions that load more when they are called."""
OF_TESTS = ("hypothesis", "playwright.sync_api", "pytest", "schemathesis", "xdist.remote")


def main() -> None:
    """Import everything, and say how long it took."""
    begun = time.monotonic()
    sys.dont_write_bytecode = False  # whatever the environment says
    for name in (*LOADED, *OF_TESTS):
        path, _, function = name.partition(":")
        loaded = import_module(path)
        if function:
            getattr(loaded, function)()
    # of what had been imported before, at the interpreter's start
    files = [Path(file) for module in list(sys.modules.values()) if (file := getattr(module, "__file__", None))]
    for file in files:
        if file.suffix == ".py" and file.is_relative_to(sys.prefix) and not Path(cache_from_source(str(file))).exists():
            py_compile.compile(str(file), doraise=True)
    sys.stdout.write(f"{len(sys.modules)} modules have their bytecode, in {time.monotonic() - begun:.0f} s\n")


if __name__ == "__main__":
    main()
