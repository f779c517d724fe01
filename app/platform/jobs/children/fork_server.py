"""A process that has imported what its children need, and forks one child per order.

It is started as `python -m app.platform.jobs.children.fork_server NICENESS NAME...`.
A fresh interpreter needs seconds until the decoders are imported. A fork of this process needs some milliseconds, and still has its own
memory. It runs one thread, so that a fork finds no lock taken, and holds no data: orders go to the children unread.

Each order is one byte on the socket at standard input. With it come three descriptors: the order's socket, the log and the pipe of
reports. The order itself, JSON, comes on its socket, which answers `{"pid": ...}` at once and `{"status": ...}`, as of `waitpid`, at the
end. If an order names a `module`, that is imported first, once, and its `prepare()` called if it has one: torch alone takes five seconds.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import select
import signal
import socket
import sys
import traceback
from contextlib import suppress
from importlib import import_module
from pathlib import Path

from app.platform.jobs.children import child

DESCRIPTORS = 3
"""Of each order: its socket, the log, the pipe of reports."""
LONGEST_ORDER = 1 << 16
LARGE_PAGE = 1 << 21
"""Bytes."""
_COLLAPSE = 25  # MADV_COLLAPSE of madvise(2), Linux 6.1 and newer


def main(arguments: list[str]) -> int:
    """Import modules (`module`), call what is to be made ready (`module:function`), and serve until the starter has gone."""
    child.die_with_parent()
    niceness, *names = arguments
    child.step_back(int(niceness))
    for name in names:
        module, _, function = name.partition(":")
        loaded = import_module(module)
        if function:
            getattr(loaded, function)()
    _leave_to_itself()
    with socket.socket(fileno=os.dup(0)) as orders:
        _Server(orders).serve()
    return 0


def _leave_to_itself() -> None:
    """Freeze what is loaded: the garbage collector would touch, and so copy, every page that the children share."""
    gc.collect()
    gc.freeze()


def use_large_pages() -> int:
    """Move this process's own memory to pages of 2 MB and return the bytes moved, 0 where the system cannot.

    A fork copies one entry per page, five hundred times fewer than of 4 kB. Memory is shared and copied in 4 kB as before.
    """
    if sys.platform != "linux":
        return 0
    madvise = ctypes.CDLL(None, use_errno=True).madvise
    madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    return sum(stop - start for start, stop in _own_ranges() if madvise(start, stop - start, _COLLAPSE) == 0)


def _own_ranges() -> list[tuple[int, int]]:
    """Find the ranges of whole large pages in writable memory without a file."""
    found = []
    for line in Path("/proc/self/maps").read_text().splitlines():
        place, rights, _, _, _, *named = line.split(maxsplit=5)
        if not rights.startswith("rw-p") or (named and named[0] != "[heap]"):
            continue
        start, stop = (int(end, 16) for end in place.split("-"))
        start, stop = -(-start // LARGE_PAGE) * LARGE_PAGE, stop // LARGE_PAGE * LARGE_PAGE
        if start < stop:
            found.append((start, stop))
    return found


class _Server:
    """Server that forks children and reports how they ended."""

    def __init__(self, orders: socket.socket) -> None:
        self._orders = orders
        self._running: dict[int, socket.socket] = {}
        self._loaded: set[str] = set()
        self._awake, wake = os.pipe()
        os.set_blocking(self._awake, False)
        os.set_blocking(wake, False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        self._wake = wake
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)

    def serve(self) -> None:
        """Serve orders until the other end of the socket is closed."""
        while True:
            ready, _, _ = select.select([self._orders.fileno(), self._awake], [], [])
            if self._awake in ready:
                os.read(self._awake, 1 << 12)
                self._reap()
            if self._orders.fileno() in ready:
                byte, descriptors, _, _ = socket.recv_fds(self._orders, 1, DESCRIPTORS)
                if not byte:
                    return
                self._fork(*descriptors)

    def _fork(self, order_fd: int, log: int, report: int) -> None:
        order = socket.socket(fileno=order_fd)
        call = json.loads(order.recv(LONGEST_ORDER))
        if (module := call.get("module")) is not None:
            self._load(module)
        pid = os.fork()
        if pid == 0:
            self._become_child(call, order, log, report)
        os.close(log)
        os.close(report)
        self._running[pid] = order
        _tell(order, {"pid": pid})

    def _load(self, module: str) -> None:
        """Import a module of compute functions for later children. An error is also reported by the child, in its own log."""
        if module in self._loaded:
            return
        self._loaded.add(module)
        try:
            prepare = getattr(import_module(module), "prepare", None)
            if prepare is not None:
                prepare()
        except Exception:
            traceback.print_exc()
        _leave_to_itself()

    def _reap(self) -> None:
        while self._running:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return
            with self._running.pop(pid) as order:
                _tell(order, {"status": status})

    def _become_child(self, call: dict[str, str], order: socket.socket, log: int, report: int) -> None:
        """Run the order in this process, which is the fork, and end it."""
        status = 1
        try:
            server = os.getppid()
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            os.setsid()
            nothing = os.open(os.devnull, os.O_RDONLY)
            for source, target in ((nothing, 0), (log, 1), (log, 2)):
                os.dup2(source, target)
            for fd in (nothing, log, self._awake, self._wake):
                os.close(fd)
            for held in (self._orders, order, *self._running.values()):
                held.close()
            os.environ |= {child.REPORT_FD: str(report), child.PARENT: str(server)}
            status = child.main(call["name"], Path(call["workdir"]))
        except BaseException as error:
            # in the log of the child: its places, not its values, which may be of a person
            with suppress(OSError):
                sys.stderr.write(child.places(error))
        finally:
            try:
                sys.stdout.flush()
                sys.stderr.flush()
            finally:
                os._exit(status)  # also if the log's disk is full: the fork must not go on as a second server


def _tell(order: socket.socket, words: dict[str, int]) -> None:
    try:
        order.sendall(json.dumps(words).encode() + b"\n")
    except OSError:
        traceback.print_exc()  # the process that ordered has gone


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
