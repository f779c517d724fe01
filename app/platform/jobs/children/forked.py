"""Children forked by a process that has imported what they need: they start in milliseconds. See `fork_server`."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Sequence

from app.platform.jobs.children.supervisor import Child, ChildMessages, ChildProcesses, ComputeCall
from app.platform.jobs.context import StepOutcome

MODULE = "app.platform.jobs.children.fork_server"
IDLE_S = 30.0
"""Time after its last child at which a server ends, seconds: it holds 0.2 to 0.4 GB and is back within 2 to 4 s of processor time."""


class ForkedProcesses(ChildProcesses):
    """Child processes forked by one server process. It starts with the first child and ends when idle; a killed one is replaced.

    Args:
        prepared: what the server imports (`module`) and calls (`module:function`) before it forks.
        learns: whether it also imports the module of each call before its first child, and calls its `prepare()` if there is one. Later
            children of that module then find everything loaded.
        niceness: how far the server steps back behind other processes while it imports, 0 to 19; children go by their limits.
        idle_s: time without a call after which the server ends, seconds.
    """

    def __init__(self, prepared: Sequence[str] = (), *, learns: bool = False, niceness: int = 0, idle_s: float = IDLE_S) -> None:
        super().__init__(self._fork)
        self._arguments = [str(niceness), *prepared]
        self._learns = learns
        self._idle_s = idle_s
        self._one_at_a_time = threading.Lock()
        self._server: subprocess.Popen[bytes] | None = None
        self._to_server: socket.socket | None = None
        self._counting = threading.Lock()  # never taken while the server loads, which takes seconds
        self._calls = 0
        self._used_at = 0.0
        self._alarm: threading.Timer | None = None

    def prepare(self) -> None:
        """Start the server ahead of a call that is likely to come soon; returns before the server has loaded anything."""
        self._note_use(0)
        if not self._one_at_a_time.acquire(blocking=False):
            return  # a call is starting, and the server with it
        try:
            self._connected()
        finally:
            self._one_at_a_time.release()

    def run(self, call: ComputeCall, record: Callable[[ChildMessages], None], check: Callable[[], None]) -> StepOutcome:
        """Run one call in a child of the server; see `ChildProcesses.run`."""
        self._note_use(1)
        try:
            return super().run(call, record, check)
        finally:
            self._note_use(-1)

    @property
    def server_pid(self) -> int | None:
        """Number of the server process; None while there is none."""
        return None if (server := self._server) is None else server.pid

    def close(self) -> None:
        """End the starting thread, the server and every child that is left."""
        super().close()
        with self._one_at_a_time:
            self._forget()
        with self._counting:
            if self._alarm is not None:
                self._alarm.cancel()
                self._alarm = None

    def _note_use(self, calls: int) -> None:
        """Count a call that begins (1) or ends (-1), and have the server looked at when it may be idle."""
        with self._counting:
            self._calls += calls
            self._used_at = time.monotonic()
            if self._alarm is None:
                self._set_alarm(self._idle_s)

    def _set_alarm(self, seconds: float) -> None:
        self._alarm = threading.Timer(seconds, self._end_when_idle)
        self._alarm.daemon = True
        self._alarm.start()

    def _end_when_idle(self) -> None:
        with self._one_at_a_time, self._counting:
            self._alarm = None
            if self._server is None or self._calls:
                return  # the end of the last call sets the next alarm
            if (left := self._used_at + self._idle_s - time.monotonic()) > 0:
                self._set_alarm(left)
            else:
                self._forget()

    def _fork(self, call: ComputeCall, log: int, report: int) -> Child:
        order = {"name": call.name, "workdir": str(call.workdir.resolve())}
        if self._learns:
            order["module"] = call.reference.partition(":")[0]
        with self._one_at_a_time:
            try:
                return self._order(order, log, report)
            except OSError:
                # the server was killed, as by a machine that ran out of memory: its children died with it
                self._forget()
                return self._order(order, log, report)

    def _order(self, order: dict[str, str], log: int, report: int) -> ForkedChild:
        orders = self._connected()
        mine, theirs = socket.socketpair()
        with theirs:
            mine.sendall(json.dumps(order).encode())
            socket.send_fds(orders, [b"c"], [theirs.fileno(), log, report])
        return ForkedChild(mine)

    def _connected(self) -> socket.socket:
        if self._to_server is None:
            mine, theirs = socket.socketpair()
            with theirs:
                self._server = self.open_process(["-m", MODULE, *self._arguments], stdin=theirs.fileno(), stdout=subprocess.DEVNULL)
            self._to_server = mine
        return self._to_server

    def _forget(self) -> None:
        if self._to_server is not None:
            self._to_server.close()
        server, self._to_server, self._server = self._server, None, None
        if server is not None:
            server.kill()
            server.wait()


class ForkedChild:
    """A child of the server, as `subprocess.Popen` shows one of our own. Raises OSError where the server is gone."""

    def __init__(self, order: socket.socket) -> None:
        self._order = order
        self._lines = order.makefile("rb")
        self._returncode: int | None = None
        line = self._lines.readline()
        if not line:
            self._close()
            raise BrokenPipeError("the process that forks children has gone")
        self.pid: int = json.loads(line)["pid"]

    @property
    def returncode(self) -> int | None:
        """As of `poll`, when it was asked last."""
        return self._returncode

    def poll(self) -> int | None:
        """Return its exit code, negative for a signal; None while it runs."""
        if self._returncode is None and _readable(self._order):
            self.wait()
        return self._returncode

    def wait(self) -> int:
        """Wait for its end and return its exit code."""
        if self._returncode is None:
            line = self._lines.readline()
            # without a last word the server has been killed, and the child with it
            self._returncode = os.waitstatus_to_exitcode(json.loads(line)["status"]) if line else -signal.SIGKILL
            self._close()
        return self._returncode

    def kill(self) -> None:
        """End it."""
        os.kill(self.pid, signal.SIGKILL)

    def _close(self) -> None:
        self._lines.close()
        self._order.close()


def _readable(waiting: socket.socket) -> bool:
    return bool(select.select([waiting], [], [], 0)[0])
