"""The child process of one compute step: `python -m app.platform.jobs.children.child NAME WORKDIR`.

It reads `params.json` from its folder, runs the function, and leaves `result.json` there by atomic rename. Progress goes as JSON lines to
the file descriptor that BETALOOP_REPORT_FD names; what the function prints goes to `log.txt`. It dies with the worker that started it.
"""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import json
import os
import resource
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import Any

from app.platform.errors import BetaloopError
from app.platform.jobs.children.report import StepReport, pipe_sender, write_atomically
from app.platform.jobs.errors import JobError
from app.platform.jobs.registry import load_compute

_PR_SET_PDEATHSIG = 1
_LOCK_WAIT_S = 30.0
_NICENESS = 5
_OOM_SCORE = "500"


def params_hash(name: str, params: dict[str, Any]) -> str:
    """SHA-256 of a call; equal for equal params whatever the order of their keys."""
    return hashlib.sha256(json.dumps([name, params], sort_keys=True, allow_nan=False).encode()).hexdigest()


def stored_result(workdir: Path, sha256: str) -> dict[str, Any] | None:
    """The result that an earlier run of the same call left in its folder, or None."""
    try:
        stored = json.loads((workdir / "result.json").read_bytes())
    except FileNotFoundError:
        return None
    if stored["params_sha256"] != sha256 or not stored["ok"]:
        return None
    result: dict[str, Any] = stored["result"]
    return result


def too_much_memory(limit_mb: int) -> str:
    """What the user reads when a step outgrew its limit."""
    return (
        f"The step needs more memory than its limit of {limit_mb} MiB. Make the job smaller or raise BETALOOP_JOB_MEMORY_MB for the worker."
    )


def main(arguments: list[str]) -> int:
    """Run one call; 0 when it gave a result, 1 when it failed (the reason stands in result.json), 2 for wrong arguments."""
    _die_with_parent()
    if len(arguments) != 2:
        sys.stderr.write("usage: python -m app.platform.jobs.children.child NAME WORKDIR\n")
        return 2
    name, workdir = arguments[0], Path(arguments[1])
    _be_modest()
    os.umask(0o077)  # checkpoints and results are of participants
    call = json.loads((workdir / "params.json").read_bytes())
    outcome: dict[str, Any] = {"params_sha256": call["params_sha256"]}
    lock = None
    try:
        lock = _lock(workdir)
        outcome |= {"ok": True, "result": _run(name, call, workdir)}
    except Exception as error:
        # memory to write the message with, when it was the memory that ran out
        resource.setrlimit(resource.RLIMIT_DATA, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        # stderr is the step's log, which shows the traceback to those who can read one
        traceback.print_exc()
        outcome |= {"ok": False, "message": _worded(error, call["memory_mb"])}
    write_atomically(workdir / "result.json", json.dumps(outcome, allow_nan=False).encode())
    if lock is not None:
        os.close(lock)
    return 0 if outcome["ok"] else 1


def _run(name: str, call: dict[str, Any], workdir: Path) -> dict[str, Any]:
    function = load_compute(call["function"])
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)
    # after the imports: a limit below what they need would only say so in a worse way
    limit = call["memory_mb"] << 20
    resource.setrlimit(resource.RLIMIT_DATA, (limit, resource.RLIM_INFINITY))
    report = StepReport(pipe_sender(int(os.environ["BETALOOP_REPORT_FD"])))
    result = function(call["params"], workdir, report)
    if not isinstance(result, dict):
        raise TypeError(f"compute function {name!r} must return a dict, not {type(result).__name__}")
    try:
        json.dumps(result, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise TypeError(f"compute function {name!r} must return JSON, without NaN, arrays or other objects ({error})") from error
    report.flush()
    return result


def _worded(error: Exception, memory_mb: int) -> str:
    """One line for the user."""
    text = str(error).strip()
    if isinstance(error, MemoryError) or "can't allocate memory" in text:
        return too_much_memory(memory_mb)
    if isinstance(error, BetaloopError):
        return text
    return f"{type(error).__name__}: {text.splitlines()[-1]}" if text else type(error).__name__


def _die_with_parent() -> None:
    """Let the kernel kill us when the worker's spawning thread ends, kill -9 included."""
    parent = int(os.environ.get("BETALOOP_WORKER_PID", "0"))
    if sys.platform == "linux":
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
            raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    elif parent:
        threading.Thread(target=_watch_parent, args=(parent,), daemon=True).start()
    # the worker may have died before the line above took effect
    if parent and os.getppid() != parent:
        os._exit(1)


def _watch_parent(parent: int) -> None:
    """The same where the kernel has no such service."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os.kill(os.getpid(), signal.SIGKILL)


def _be_modest() -> None:
    """Leave the processor to the web service, and offer ourselves first when the machine runs out of memory."""
    os.nice(_NICENESS)
    score = Path("/proc/self/oom_score_adj")
    if score.exists():
        score.write_text(_OOM_SCORE)


def _lock(workdir: Path) -> int:
    """Hold the folder alone: a child of a worker that was given up too early may still be at it for a moment."""
    fd = os.open(workdir / ".lock", os.O_RDWR | os.O_CREAT, 0o600)
    deadline = time.monotonic() + _LOCK_WAIT_S
    while True:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return fd
        except BlockingIOError:
            if time.monotonic() > deadline:
                raise JobError(f"Another process still works in {workdir}.", "Wait until it ends or end it, then retry the job.") from None
            time.sleep(0.1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
