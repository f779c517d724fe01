"""The child process of one compute step, a fork of `fork_server`.

It reads `params.json` from its folder, runs the function within its limits, and leaves `result.json` there by atomic rename. Progress goes
as JSON lines to the file descriptor that BETALOOP_REPORT_FD names; what the function prints goes to `log.txt`. It dies with the process
that started it.
"""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import json
import math
import os
import resource
import shutil
import signal
import sys
import threading
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any, Literal

from app.platform.errors import FULL, BetaloopError
from app.platform.jobs.children.report import StepReport, pipe_sender, write_atomically
from app.platform.jobs.context import JobError
from app.platform.jobs.registry import load_compute

REPORT_FD = "BETALOOP_REPORT_FD"
"""Names the descriptor of the pipe of reports."""
PARENT = "BETALOOP_WORKER_PID"
"""Names the process that must live as long as the child."""
STEPPED_BACK = "BETALOOP_STEPPED_BACK"
"""Names how far the process whose fork we are has stepped back."""
_PR_SET_PDEATHSIG = 1
_LOCK_WAIT_S = 30.0
_OOM_SCORE = "500"
_AUTOGROUP, _AUTOGROUP_TRIES = Path("/proc/self/autogroup"), 50
_AUTOGROUPS_ON = Path("/proc/sys/kernel/sched_autogroup_enabled")

Cause = Literal["memory", "time", "full", "away", "killed", "error"]
"""Reason for a missing result: the call reached its limit of memory or time, its process was killed, or it raised. Or the disk is full, or
the store of files is away."""
LEAST_ROOM = 1 << 16
"""Bytes: a disk with less is full."""
NO_ROOM = 28
"""Exit code of a child that met a full disk, on which not even that may have had room in result.json."""
FULL_DISK = "There is no room left on the disk of the machine that computes. Make room there, then start this again."


@dataclass(frozen=True)
class ChildLimits:
    """Limits of what one child may take of the machine.

    Attributes:
        memory_mb: data of the process, what it has imported included, MiB.
        cpu_s: seconds of processor time, which a busy machine does not use up; None for no limit.
        niceness: how far it steps back behind other processes, 0 (not at all) to 19.
        quotes: whether its log may quote what its function works on. Files of strangers may name a person: then it may not.
    """

    memory_mb: int
    cpu_s: int | None = None
    niceness: int = 0
    quotes: bool = True


def params_hash(name: str, params: dict[str, Any]) -> str:
    """Compute the SHA-256 of a call; equal for equal params whatever the order of their keys."""
    return hashlib.sha256(json.dumps([name, params], sort_keys=True, allow_nan=False).encode()).hexdigest()


def stored_result(workdir: Path, sha256: str) -> dict[str, Any] | None:
    """Read the result that an earlier run of the same call left in its folder, or None."""
    try:
        stored = json.loads((workdir / "result.json").read_bytes())
    except FileNotFoundError:
        return None
    if stored["params_sha256"] != sha256 or not stored["ok"]:
        return None
    result: dict[str, Any] = stored["result"]
    return result


def too_much_memory(limit_mb: int) -> str:
    """Phrase the message for a step that outgrew its memory limit."""
    return (
        f"The step needs more memory than its limit of {limit_mb} MiB. Make the job smaller or raise BETALOOP_JOB_MEMORY_MB for the worker."
    )


def main(name: str, workdir: Path) -> int:
    """Run one call and return its exit code: 0 for a result, NO_ROOM for a full disk, else 1, with the reason in result.json."""
    die_with_parent()
    os.umask(0o077)  # checkpoints and results are of participants
    call = json.loads((workdir / "params.json").read_bytes())
    limits = ChildLimits(**call["limits"])
    _be_modest(limits)
    outcome: dict[str, Any] = {"params_sha256": call["params_sha256"]}
    lock = None
    try:
        lock = _lock(workdir)
        outcome |= {"ok": True, "result": _run(name, call, limits, workdir)}
    except Exception as error:
        # memory to write the message with, when it was the memory that ran out
        resource.setrlimit(resource.RLIMIT_DATA, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        # stderr is the step's log, which shows the traceback to those who can read one; its disk may be full
        with suppress(OSError):
            if limits.quotes:
                traceback.print_exc()
            else:
                sys.stderr.write(places(error))
        cause = _cause(error, workdir)
        outcome |= {"ok": False, "cause": cause, "message": FULL_DISK if cause == "full" else _worded(error, limits)}
    try:
        write_atomically(workdir / "result.json", json.dumps(outcome, allow_nan=False).encode())
    except OSError as error:
        if error.errno not in FULL:
            raise
        return NO_ROOM
    if lock is not None:
        os.close(lock)
    return 0 if outcome["ok"] else 1


def places(error: BaseException) -> str:
    """Format the kind of an error and the lines of code that it passed, without the values that it may quote."""
    return "".join([*traceback.format_tb(error.__traceback__), type(error).__name__, "\n"])


def _run(name: str, call: dict[str, Any], limits: ChildLimits, workdir: Path) -> dict[str, Any]:
    function = load_compute(call["function"])
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)
    # after the imports: a limit below what they need would only say so in a worse way
    resource.setrlimit(resource.RLIMIT_DATA, (limits.memory_mb << 20, resource.RLIM_INFINITY))
    if limits.cpu_s is not None:
        used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(used) + limits.cpu_s, resource.RLIM_INFINITY))
    report = StepReport(pipe_sender(int(os.environ[REPORT_FD])))
    result = function(call["params"], workdir, report)
    if not isinstance(result, dict):
        raise TypeError(f"compute function {name!r} must return a dict, not {type(result).__name__}")
    try:
        json.dumps(result, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise TypeError(f"compute function {name!r} must return JSON, without NaN, arrays or other objects ({error})") from error
    report.flush()
    return result


def _lacked_memory(error: Exception) -> bool:
    return isinstance(error, MemoryError) or "can't allocate memory" in str(error)


def _cause(error: Exception, workdir: Path) -> Cause:
    if _lacked_memory(error):
        return "memory"
    if isinstance(error, BetaloopError) and error.status == HTTPStatus.SERVICE_UNAVAILABLE:
        return "away"  # compute functions use no database
    if isinstance(error, OSError) and error.errno is not None:
        return "full" if error.errno in FULL else "error"
    # numpy and torch do not say why they could not write
    unsaid = isinstance(error, OSError | RuntimeError) and shutil.disk_usage(workdir).free < LEAST_ROOM
    return "full" if unsaid else "error"


def _worded(error: Exception, limits: ChildLimits) -> str:
    """Phrase an error in one line for the user."""
    if _lacked_memory(error):
        return too_much_memory(limits.memory_mb)
    text = str(error).strip()
    if isinstance(error, BetaloopError):
        return text
    if not limits.quotes:
        return type(error).__name__
    return f"{type(error).__name__}: {text.splitlines()[-1]}" if text else type(error).__name__


def die_with_parent() -> None:
    """Let the kernel kill us when the thread that started us ends, kill -9 included."""
    parent = int(os.environ.get(PARENT, "0"))
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
    """Kill this process when its parent dies, on systems whose kernel offers no such service."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os.kill(os.getpid(), signal.SIGKILL)


def _be_modest(limits: ChildLimits) -> None:
    """Lower this process's priority, let it be killed first when memory runs out, and write no core dump."""
    step_back(limits.niceness)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    score = Path("/proc/self/oom_score_adj")
    if score.exists():
        score.write_text(_OOM_SCORE)


def step_back(niceness: int) -> None:
    """Raise this process's niceness by `niceness`, 0 to 19, over its starter's, and apply it against every other process.

    A fork of a process that has stepped back already adds only what is missing. Linux (sched(7), "The autogroup feature") divides the
    processor among sessions first. Ours has one process, in which niceness alone has no effect.
    """
    if niceness <= 0:
        return
    nice = os.nice(max(0, niceness - int(os.environ.get(STEPPED_BACK, "0"))))
    os.environ[STEPPED_BACK] = str(niceness)
    if not (_AUTOGROUPS_ON.exists() and _AUTOGROUPS_ON.read_text().strip() == "1" and _AUTOGROUP.exists()):
        return  # niceness counts by itself
    for _ in range(_AUTOGROUP_TRIES):
        try:
            _AUTOGROUP.write_text(str(nice))
            return
        except BlockingIOError:
            time.sleep(0.1)  # users other than root may do this once in a tenth of a second
        except OSError as error:  # as in a container whose /proc is read-only
            sys.stderr.write(f"this step does not step back behind other processes: {error}\n")
            return
    sys.stderr.write(f"this step does not step back behind other processes: the kernel refused it {_AUTOGROUP_TRIES} times\n")


def _lock(workdir: Path) -> int:
    """Lock the folder: a child of a worker that was given up too early may still use it for a moment."""
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
