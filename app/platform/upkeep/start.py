"""Start and end of a process: what a start needs, why a command failed in one line, and a watchdog that ends what hangs."""

from __future__ import annotations

import errno
import logging
import os
import socket
import threading
import time
from tempfile import TemporaryFile

from pydantic import ValidationError
from sqlalchemy.exc import OperationalError

from app.platform.database import database_place
from app.platform.errors import FULL, BetaloopError, Conflict
from app.settings import Settings, get_settings

log = logging.getLogger(__name__)

_WHY = {
    errno.EADDRINUSE: ("another program listens there", "Is betaloop running already? Else choose another port: --port {free}."),
    errno.EACCES: ("this user may not listen there", "Choose a port from 1024 up: --port 8000. A proxy before it may have port 443."),
    **dict.fromkeys(
        (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT),
        ("this machine has no such address", "Give one that it has, or 0.0.0.0 for all of them: --host."),
    ),
}


def require_free(host: str, port: int) -> None:
    """Raise Conflict where this port of this machine is taken, at each of the addresses that a name means here."""
    try:
        if not 0 <= port < 1 << 16:
            raise OverflowError("no port")  # which some systems would cut to 16 bits
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, OverflowError, UnicodeError) as error:
        raise Conflict(f"No service can listen at {host}:{port}: there is no such address.", "Give another: --host, --port.") from error
    refusals = [refused for family, _, _, _, address in found if (refused := _refusal(family, address)) is not None]
    absent = [refused for refused in refusals if refused.errno in _ABSENT]
    # `localhost` is an address of each kind, of which a machine may lack one
    if len(absent) == len(refusals) < len(found):
        return
    first = next((refused for refused in refusals if refused not in absent), refusals[0])
    why, hint = _WHY.get(first.errno or 0, (str(first.strerror), "Give another address: --host, --port."))
    raise Conflict(f"No service can listen at {host}:{port}: {why}.", hint.format(free=_next_free(host, port))) from first


def _next_free(host: str, port: int) -> int:
    """Return the next port above at which a service can listen here; 8000 where there is none."""
    for other in range(port + 1, 1 << 16):
        found = socket.getaddrinfo(host, other, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        refusals = [_refusal(family, address) for family, _, _, _, address in found]
        if not any(refused is not None and refused.errno not in _ABSENT for refused in refusals):
            return other
    return 8000


_ABSENT = {errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT}


def _refusal(family: int, address: tuple[str, int] | tuple[str, int, int, int] | tuple[int, bytes]) -> OSError | None:
    """Return why listening at an address fails; None where it works."""
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port that was left a moment ago is free
            if family == socket.AF_INET6:
                probe.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)  # as the service does
            probe.bind(address)
    except OSError as error:
        return error
    return None


def require_data_folder() -> None:
    """Make the data folder and try it, before the first upload does. A full disk is no reason not to start: a start makes room.

    Raises:
        OSError: it cannot be written to.
    """
    folder = get_settings().data_dir
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        if error.errno not in FULL:
            raise type(error)(error.errno, error.strerror, str(folder)) from error


_NOT_REACHED = {None, "28P01", "28000", "3D000", "57P03", "53300"}
"""SQLSTATE of a server that is not there, refuses who asks, has no such database, starts, or has no connection left."""
_DATABASE_HINT = (
    "Start it, or correct BETALOOP_DATABASE_URL (BETALOOP_OWNER_URL for migrate, backup and restore); `betaloop where` reads them."
)
_RIGHTS = "Run betaloop as the user whom it belongs to, or give this one the right"
_NO_FOLDER = "There is a file where a folder is wanted: name another place"
_FOLDER_HINTS = {
    errno.EACCES: _RIGHTS,
    errno.EPERM: _RIGHTS,
    errno.EROFS: "It is mounted for reading alone: mount it for writing, or name another place",
    errno.ENOSPC: "Make room on its disk, then do this again",
    errno.EDQUOT: "Have this user's quota raised or make room, then do this again",
    errno.ENOTDIR: _NO_FOLDER,
    errno.EEXIST: _NO_FOLDER,
}


def in_one_line(error: Exception) -> str | None:
    """Explain why a command failed and what to do about it; None for what is a fault of ours."""
    if isinstance(error, BetaloopError | RuntimeError):
        return str(error)
    if isinstance(error, OperationalError) and getattr(error.orig, "sqlstate", None) in _NOT_REACHED:
        return f"the database at {database_place()} does not let us in. It says: {_last_line(error.orig)} {_DATABASE_HINT}"
    if isinstance(error, ValidationError) and error.title == Settings.__name__:
        wrong = (f"BETALOOP_{'_'.join(map(str, e['loc'])).upper()}={e['input']}: {e['msg']}" for e in error.errors())
        return f"{'; '.join(wrong)}. Correct the environment or the file .env."
    if isinstance(error, OSError) and error.errno in _FOLDER_HINTS and error.filename is not None:
        return f"{error.filename}: {error.strerror}. {_FOLDER_HINTS[error.errno]} (the data folder is BETALOOP_DATA_DIR)."
    return None


def _last_line(error: BaseException | None) -> str:
    """Return the last line of a message of a server or its library, ending as a sentence does."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip() and "Is the server running" not in line]
    return f"{lines[-1].rstrip('.') if lines else 'nothing'}."


OVERDUE_S = 60.0
"""Longest time between two beats of a process that works."""
STOP_S, STOP_WITH_DATABASE_S = 9.0, 60.0
"""Longest time that a stop may take; the second where the process stops the embedded database, too."""
_LOOK_S = 1.0


class Watchdog:
    """Thread that ends the process when its beat is overdue, or when a stop takes too long. The service manager starts it again.

    A network that loses everything that is sent gives no answer and no error. A call of the database then waits for ever.

    Args:
        stop: set when the process is asked to stop.
        overdue_s: longest time between two beats; it counts from the first one.
    """

    def __init__(self, stop: threading.Event, overdue_s: float = OVERDUE_S) -> None:
        self._stop, self._overdue_s = stop, overdue_s
        self._silent_s: float | None = None
        threading.Thread(target=self._watch, name="watchdog", daemon=True).start()

    def beat(self) -> None:
        """Say that the process goes on."""
        self._silent_s = 0.0

    def _watch(self) -> None:
        # Looks are counted and not the clock: while the whole process pauses, as on a machine that sleeps, nothing is overdue.
        while not self._stop.wait(_LOOK_S):
            if self._silent_s is None:
                continue
            self._silent_s += _LOOK_S
            if self._silent_s > self._overdue_s:
                _end(1, f"nothing went on for {self._overdue_s:.0f} s, most likely because the database neither answers nor refuses")
        time.sleep(STOP_S if get_settings().database_url else STOP_WITH_DATABASE_S)
        _end(0, "the stop takes too long; what is unfinished is taken up again later")


def _end(code: int, why: str) -> None:
    log.critical("this process ends at once: %s", why)
    os._exit(code)
