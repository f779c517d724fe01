"""The twelve machines. Each case begins with a clone and returns its result in words; it raises `Fails` where something else happens."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tests.newcomers.machine import REFUSAL_S, Fails, Machine, free_port, patience, take_over

WORKS = "page and upload"
WITHOUT_ENTRY = 54321
"""A user id that no machine has in /etc/passwd."""
_NO_SYSTEM_FOLDER = 'mkdir -p /var/lib/betaloop && mount -t tmpfs -o ro none /var/lib/betaloop && exec "$@"'


@dataclass
class Ground:
    """The folders and users of one run.

    Args:
        work: an open folder. source: a repository that everybody may read. suite: the clone in root's closed home, in which the suite
            runs afterwards. python: an interpreter for root. open_python: one that every user may run.
    """

    work: Path
    source: Path
    suite: Path
    python: str
    open_python: str
    users: list[str] = field(default_factory=list)
    installed: dict[str, Machine] = field(default_factory=dict)

    def folder(self, name: str, mode: int = 0o755, owner: int = 0) -> Path:
        """Make a folder."""
        path = self.work / name
        path.mkdir()
        path.chmod(mode)
        os.chown(path, owner, owner)
        return path

    def root(self, folder: Path, **other: object) -> Machine:
        """Return a machine on which root clones into a folder."""
        machine = Machine(folder, folder, env={"PYTHON": self.python}).changed(**other)
        return self._cloned(machine)

    def ordinary(self, *options: str) -> Machine:
        """Return a machine of a new ordinary user with a closed home."""
        name = f"bl-{uuid.uuid4().hex[:8]}"
        home = self.work / name
        subprocess.run(["useradd", "--create-home", "--home-dir", str(home), "--shell", "/bin/sh", name], check=True, capture_output=True)
        self.users.append(name)
        home.chmod(0o700)
        return self._cloned(Machine(home, home, name, env={"PYTHON": self.open_python}), *options)

    def _cloned(self, machine: Machine, *options: str) -> Machine:
        target = machine.clone / "betaloop"
        if machine.user:
            machine.run("git", "config", "--global", "safe.directory", "*")  # the repository is root's
        machine.run("git", "clone", "--quiet", *options, f"file://{self.source}", str(target))
        return machine.changed(clone=target)


def root_in_a_closed_home(ground: Ground) -> str:
    """Install and start where the suite runs afterwards, stop, and start again."""
    machine = Machine(ground.suite, ground.suite.parent, env={"PYTHON": ground.python})
    for _ in range(2):
        demo = machine.start()
        demo.page(installs=True)
        demo.stop()
    machine.run("rm", "-rf", "var")
    ground.installed["root"] = machine
    return f"{WORKS}, also at a second start"


def ordinary_user(ground: Ground) -> str:
    """Install and start as a user who is not root."""
    machine = ground.ordinary()
    _works(machine, installs=True)
    ground.installed["user"] = machine
    return WORKS


def closed_data_folder(ground: Ground) -> str:
    """Start from an open folder with the data in a closed one."""
    machine = ground.root(ground.folder("open"))
    take_over(ground.installed["root"].clone, machine.clone)
    ground.installed["open"] = machine
    return _works(_with_data(machine, ground.folder("closed-data", 0o700) / "data"))


def special_path(ground: Ground) -> str:
    """Install and start below a folder with a space, an apostrophe and a letter that is not ASCII."""
    return _works(ground.root(ground.folder("Klinik Süd's study")), installs=True)


def closed_umask(ground: Ground) -> str:
    """Install and start with files that only root may read."""
    return _works(ground.root(ground.folder("umask"), umask=0o077), installs=True)


def no_home(ground: Ground) -> str:
    """Start without HOME, as a service manager does."""
    machine = ground.installed["open"].changed(home=None)
    return _works(_with_data(machine, ground.folder("no-home") / "data"))


def user_without_entry(ground: Ground) -> str:
    """Start under a user id that /etc/passwd does not know, as containers do."""
    machine = ground.root(ground.folder("container"))
    take_over(ground.installed["user"].clone, machine.clone)
    ids = ("setpriv", f"--reuid={WITHOUT_ENTRY}", f"--regid={WITHOUT_ENTRY}", "--clear-groups")
    machine = _with_data(machine.changed(before=ids, home=None), ground.folder("container-data", 0o700, WITHOUT_ENTRY))
    said = machine.refused()
    _require(said, str(WITHOUT_ENTRY), "/etc/passwd", "BETALOOP_DATABASE_URL")
    return "one sentence: the id, the missing entry, three ways on"


def taken_port(ground: Ground) -> str:
    """Start where another program listens."""
    machine = _with_data(ground.installed["open"], ground.folder("taken-port") / "data")
    with socket.create_server(("127.0.0.1", free_port())) as other:
        port = int(other.getsockname()[1])
        said = machine.refused(port=port)
    _require(said, f"127.0.0.1:{port}", "another program listens there")
    named = re.search(r"--port (\d+)", said)
    if named is None or int(named.group(1)) <= port:
        raise Fails(f"no free port is named: {said}")
    return "one sentence: the port, and the next free one"


def no_system_folder(ground: Ground) -> str:
    """Start below a closed home where /var/lib/betaloop cannot be written."""
    machine = ground.installed["root"].changed(before=("unshare", "--mount", "sh", "-c", _NO_SYSTEM_FOLDER, "sh"))
    said = _with_data(machine, ground.folder("no-system-folder", 0o700) / "data").refused()
    _require(said, "/var/lib/betaloop", "BETALOOP_DATA_DIR", "BETALOOP_DATABASE_URL")
    return "one sentence: the folder, two ways on"


def two_first_starts(ground: Ground) -> str:
    """Start two demos of one data folder at once."""
    machine = _with_data(ground.installed["open"], ground.folder("two-starts") / "data")
    demos = [machine.start(), machine.start()]
    deadline = time.monotonic() + REFUSAL_S * patience()
    while all(demo.process.poll() is None for demo in demos):
        if time.monotonic() > deadline:
            raise Fails("neither of two demos of one data folder gave way: " + " ".join(demo.output() for demo in demos))
        time.sleep(0.1)
    demos.sort(key=lambda demo: demo.process.poll() is None)
    refused, working = demos
    said = refused.refusal(alone=False)
    _require(said, str(machine.data()), f"http://127.0.0.1:{working.port}")
    working.page()
    working.stop()
    return f"one: {WORKS}; the other: one sentence with its address"


def second_user(ground: Ground) -> str:
    """Start a clone of a second user while the first user's demo runs."""
    first = ground.installed["user"]
    machine = ground.ordinary()
    take_over(first.clone, machine.clone)
    runs = first.start()
    runs.page()
    _works(machine)
    runs.stop()
    return WORKS


def read_only_checkout(ground: Ground) -> str:
    """Start a shallow clone that its user cannot write to, with the data elsewhere."""
    machine = ground.ordinary("--depth", "1")
    take_over(ground.installed["user"].clone, machine.clone)
    machine.run("find", ".", "-path", "./.venv", "-prune", "-o", "-exec", "chmod", "a-w", "{}", "+")
    result = _works(_with_data(machine, machine.clone.parent / "data"))
    machine.run("find", ".", "-path", "./.venv", "-prune", "-o", "-type", "d", "-exec", "chmod", "u+w", "{}", "+")
    return result


def _works(machine: Machine, installs: bool = False) -> str:
    demo = machine.start()
    demo.page(installs)
    demo.stop()
    return WORKS


def _with_data(machine: Machine, data: Path) -> Machine:
    return machine.changed(env=machine.env | {"BETALOOP_DATA_DIR": str(data)})


def _require(said: str, *facts: str) -> None:
    missing = [fact for fact in facts if fact not in said]
    if missing:
        raise Fails(f"{missing} not in: {said}")


@dataclass(frozen=True)
class Case:
    """One machine: a letter and a sentence for the table, and the function that tries it."""

    letter: str
    machine: str
    try_it: Callable[[Ground], str]


LANES = (
    (
        Case("a", "root; clone and virtual environment below a home of mode 0700", root_in_a_closed_home),
        Case("c", "root; clone in an open folder, data folder in a closed one", closed_data_folder),
        Case("f", "root; HOME not set", no_home),
        Case("h", "the port is taken", taken_port),
        Case("i", "root in a closed home; `/var/lib/betaloop` not writable", no_system_folder),
        Case("j", "two first starts of one data folder at once", two_first_starts),
        Case("d", "a path with a space, an apostrophe and a letter that is not ASCII", special_path),
    ),
    (
        Case("b", "ordinary user; home of mode 0700", ordinary_user),
        Case("g", "a user id without an entry in `/etc/passwd`", user_without_entry),
        Case("k", "a second user with a clone of his own, while the first one's demo runs", second_user),
        Case("l", "`git clone --depth 1`, read-only checkout, data elsewhere", read_only_checkout),
        Case("e", "umask 077", closed_umask),
    ),
)
"""The cases of a lane follow each other, since later ones use what earlier ones installed; lanes run side by side."""
