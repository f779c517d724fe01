"""The starter's side of child processes: starts them, reads their reports, watches their memory, kills them."""

from __future__ import annotations

import json
import os
import queue
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import psutil

from app.platform.jobs.children.child import FULL_DISK, NO_ROOM, PARENT, Cause, ChildLimits, params_hash, stored_result, too_much_memory
from app.platform.jobs.children.report import write_atomically
from app.platform.jobs.context import StepOutcome
from app.settings import private_folder

LISTEN_S = 0.1
"""Longest time between two looks at a child, and so the longest that it outlives a cancel."""
REPORT_S = 0.5
"""Least time between two reports to the database."""
MEMORY_CHECK_S = 0.5
LOG_TAIL = 6000
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


@dataclass(frozen=True)
class ComputeCall:
    """One call of a compute function: its name, where it is, as `module:function`, and the version of the code that runs it."""

    name: str
    reference: str
    params: dict[str, Any]
    workdir: Path
    limits: ChildLimits
    code_version: str = ""

    @property
    def sha256(self) -> str:
        """Hash of name and params."""
        return params_hash(self.name, self.params)


@dataclass
class ChildMessages:
    """Reports of a child since the last look."""

    progress: float | None = None
    message: str | None = None
    points: list[dict[str, Any]] | None = None
    logs: list[str] | None = None

    def add(self, line: str) -> None:
        """Take in one line of the pipe."""
        members: dict[str, Any] = json.loads(line)
        self.progress = members.get("progress", self.progress)
        self.message = members.get("message", self.message)
        if (points := members.get("points")) is not None:
            self.points = (self.points or []) + points
        if (log := members.get("log")) is not None:
            self.logs = [*(self.logs or []), log]

    def __bool__(self) -> bool:
        return any(part is not None for part in (self.progress, self.message, self.points, self.logs))


class Child(Protocol):
    """A running child, as `subprocess.Popen` is one."""

    @property
    def pid(self) -> int:
        """Its number, which is its process group's too."""

    @property
    def returncode(self) -> int | None:
        """As of `poll`, when it was asked last."""

    def poll(self) -> int | None:
        """Return its exit code, negative for a signal; None while it runs."""

    def wait(self) -> int:
        """Wait for its end and return its exit code."""

    def kill(self) -> None:
        """End it."""


Starter = Callable[[ComputeCall, int, int], Child]
"""Starts the child of a call, whose folder is ready, with this log and this pipe of reports, in a session of its own."""
_Popen = subprocess.Popen[bytes]
_Order = tuple[Callable[[], _Popen], Future[_Popen]]


class ChildProcesses:
    """Starts every process from one thread, because the kernel's parent-death signal fires when the starting *thread* ends.

    Args:
        start: starts a child.
    """

    def __init__(self, start: Starter) -> None:
        self._start_child = start
        self._orders: queue.SimpleQueue[_Order | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="child-starter", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the starting thread, and with it every child that is left."""
        self._orders.put(None)
        self._thread.join()

    def run(self, call: ComputeCall, record: Callable[[ChildMessages], None], check: Callable[[], None]) -> StepOutcome:
        """Run one call in a child process, or take the result that it left before a crash.

        Args:
            call: what to run, and where.
            record: takes what the child reports, at most once per REPORT_S.
            check: called every LISTEN_S; raises to have the child killed.

        Returns:
            The outcome; a failed one has the end of the child's log under `log`.
        """
        _prepare(call)
        if (result := stored_result(call.workdir, call.sha256)) is not None:
            return {"ok": True, "result": result}
        log = call.workdir / "log.txt"
        log_start = log.stat().st_size if log.exists() else 0
        process, pipe = self._start(call, log)
        try:
            outgrown = _listen(process, pipe, call.limits.memory_mb, record, check)
        finally:
            os.close(pipe)
            _kill(process)
        outcome = _outcome(call, process.wait(), outgrown)
        if not outcome["ok"]:
            outcome["log"] = log.read_bytes()[log_start:][-LOG_TAIL:].decode(errors="replace")
        return outcome

    def open_process(self, arguments: list[str], **named: Any) -> subprocess.Popen[bytes]:
        """Start a Python process that lives no longer than this one, with its libraries on one thread; see `subprocess.Popen`."""
        env = (
            os.environ
            | ONE_THREAD
            | {PARENT: str(os.getpid()), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
            | named.pop("env", {})
        )

        def start() -> _Popen:
            return subprocess.Popen([sys.executable, *arguments], env=env, start_new_session=True, **named)

        started: Future[_Popen] = Future()
        self._orders.put((start, started))
        return started.result()

    def _start(self, call: ComputeCall, log: Path) -> tuple[Child, int]:
        reader, writer = os.pipe()
        with log.open("ab") as out:
            try:
                return self._start_child(call, out.fileno(), writer), reader
            except BaseException:
                os.close(reader)
                raise
            finally:
                os.close(writer)

    def _work(self) -> None:
        while order := self._orders.get():
            start, started = order
            try:
                started.set_result(start())
            except OSError as error:
                started.set_exception(error)


def _prepare(call: ComputeCall) -> None:
    """Make the folder ready; what another call left there (its checkpoints do not fit) is removed."""
    params = call.workdir / "params.json"
    if call.workdir.exists() and (not params.exists() or json.loads(params.read_bytes())["params_sha256"] != call.sha256):
        shutil.rmtree(call.workdir)
    private_folder(call.workdir)
    content = {"function": call.reference, "params": call.params, "params_sha256": call.sha256, "limits": asdict(call.limits)}
    content["code_version"] = call.code_version
    write_atomically(params, json.dumps(content, allow_nan=False).encode())
    result = call.workdir / "result.json"
    if result.exists() and stored_result(call.workdir, call.sha256) is None:
        result.unlink()  # of a failed attempt


def take_over(call: ComputeCall, left: Path) -> bool:
    """Copy the folder that the same call of another job left with its result; True where the same code made it of the same params."""
    if call.workdir.exists() or stored_result(left, call.sha256) is None:
        return False
    if json.loads((left / "params.json").read_bytes()).get("code_version") != call.code_version:
        return False
    draft = call.workdir.with_name(f".{call.workdir.name}")
    shutil.rmtree(draft, ignore_errors=True)  # of a copy that was cut short
    shutil.copytree(left, draft)
    draft.rename(call.workdir)
    return True


def _listen(process: Child, pipe: int, memory_mb: int, record: Callable[[ChildMessages], None], check: Callable[[], None]) -> bool:
    """Read what a child reports until it ends; whether it has to be killed because it outgrew its limit of memory."""
    messages, rest, open_ = ChildMessages(), b"", True
    reported = measured = time.monotonic()
    while open_ or process.poll() is None:
        check()
        if open_ and select.select([pipe], [], [], LISTEN_S)[0]:
            chunk = os.read(pipe, 1 << 16)
            open_ = bool(chunk)
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                messages.add(line.decode())
        elif not open_:
            time.sleep(0.01)
        present = time.monotonic()
        if messages and present - reported >= REPORT_S:
            record(messages)
            messages, reported = ChildMessages(), present
        if present - measured >= MEMORY_CHECK_S:
            measured = present
            if _resident_mb(process.pid) > memory_mb:
                return True
        if process.poll() is not None and not select.select([pipe], [], [], 0)[0]:
            break  # a grandchild may hold the pipe open
    if messages:
        record(messages)
    return False


def _resident_mb(pid: int) -> float:
    try:
        return float(psutil.Process(pid).memory_info().rss) / (1 << 20)
    except psutil.NoSuchProcess:
        return 0.0


def _kill(process: Child) -> None:
    if process.poll() is None:
        try:
            os.killpg(process.pid, signal.SIGKILL)  # its own session: its children go too
        except ProcessLookupError:
            process.kill()
    process.wait()


def _outcome(call: ComputeCall, returncode: int, outgrown: bool) -> StepOutcome:
    if outgrown:
        return _failed("memory", too_much_memory(call.limits.memory_mb))
    try:
        stored: dict[str, Any] = json.loads((call.workdir / "result.json").read_bytes())
    except FileNotFoundError:
        if returncode == NO_ROOM:
            return _failed("full", FULL_DISK)
        if returncode >= 0:
            return _failed("killed", f"The step's process ended with exit code {returncode} and without a result; see the step's log.")
        name = signal.Signals(-returncode).name
        if name == "SIGXCPU":
            return _failed("time", f"The step's process took more than its limit of {call.limits.cpu_s} s of processor time.")
        why = "most likely because the machine ran out of memory" if name == "SIGKILL" else "see the step's log"
        return _failed("killed", f"The step's process was killed from outside ({name}), {why}.")
    if stored["ok"]:
        return {"ok": True, "result": stored["result"]}
    return _failed(stored["cause"], stored["message"])


def _failed(cause: Cause, message: str) -> StepOutcome:
    return {"ok": False, "cause": cause, "message": message}
