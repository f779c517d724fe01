"""One newcomer's machine: a clone in a folder, a user with an environment, and the demo started there. Standard library alone."""

from __future__ import annotations

import http.cookiejar
import os
import re
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
import uuid
from dataclasses import dataclass, field, replace
from pathlib import Path

PAGE_S = 120.0
INSTALL_S = 900.0
REFUSAL_S = 20.0
STOP_S = 60.0
SESSION = "t_s,beta,amplitude_fraction\n" + "".join(f"{2 * (k + 1)},{1 + k % 3},{(k % 4) / 4}\n" for k in range(150))
"""A session of five minutes as a table."""


class Fails(Exception):
    """The machine did not do what its case says."""


def patience() -> float:
    """Return how much longer things take while other work shares the processors."""
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def free_port() -> int:
    """Return a port without a listener."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass(frozen=True)
class Machine:
    """A clone and the conditions under which its commands run.

    Args:
        clone: the folder of the clone. home: HOME; None leaves it unset. user: a name, or None for root.
        umask: of every command. env: more variables. before: words in front of every command (a mount, another user id).
    """

    clone: Path
    home: Path | None
    user: str | None = None
    umask: int = 0o022
    env: dict[str, str] = field(default_factory=dict)
    before: tuple[str, ...] = ()

    def changed(self, **other: object) -> Machine:
        """Return the same machine under other conditions."""
        return replace(self, **other)  # type: ignore[arg-type]

    def command(self, *words: str) -> list[str]:
        """Return the words that run a command as this machine's user."""
        as_user = ("setpriv", f"--reuid={self.user}", f"--regid={self.user}", "--init-groups") if self.user else ()
        return [*self.before, *as_user, *words]

    def environment(self) -> dict[str, str]:
        """Return what its commands find in their environment: nothing of this run but where packages come from."""
        kept = {k: v for k, v in os.environ.items() if k in {"PATH", "TMPDIR", "BETALOOP_SERVER_USER"} or k.startswith(("PIP_", "SSL_"))}
        if self.user:
            kept.pop("TMPDIR", None)
        home = {"HOME": str(self.home)} if self.home else {}
        return kept | home | {"LANG": "C.UTF-8", "OMP_NUM_THREADS": "1"} | self.env

    def run(self, *words: str, timeout: float = INSTALL_S) -> str:
        """Run a command in the clone and return its output. Raises Fails where it does not succeed."""
        done = subprocess.run(
            self.command(*words), cwd=self.clone, env=self.environment(), umask=self.umask, timeout=timeout * patience(),
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        )  # fmt: skip
        if done.returncode != 0:
            raise Fails(f"{' '.join(words)} ended with {done.returncode}:\n{done.stdout[-4000:]}")
        return done.stdout

    def start(self, *words: str, port: int | None = None) -> Demo:
        """Start a demo (by default with `make demo`), at a free port where none is named."""
        port = port or free_port()
        said = self.clone.parent / f"said-{uuid.uuid4().hex[:6]}.txt"
        with said.open("wb") as out:
            process = subprocess.Popen(
                self.command(*(words or ("make", "demo"))), cwd=self.clone, env=self.environment() | {"BETALOOP_PORT": str(port)},
                umask=self.umask, stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True,
            )  # fmt: skip
        return Demo(self, process, said, port)

    def refused(self, *words: str, port: int | None = None) -> str:
        """Start a demo that cannot work and return its last words. Raises Fails where it goes on, or ends late or without words."""
        return self.start(*words, port=port).refusal()

    def data(self) -> Path:
        """Return the data folder."""
        return Path(self.env.get("BETALOOP_DATA_DIR", self.clone / "var"))


@dataclass
class Demo:
    """A demo that was started, and the words that it printed so far."""

    machine: Machine
    process: subprocess.Popen[bytes]
    said: Path
    port: int
    begun: float = field(default_factory=time.monotonic)

    def output(self) -> str:
        """Return what it printed."""
        return self.said.read_text(errors="replace")

    def page(self, installs: bool = False) -> None:
        """Wait for the address, sign in and upload a file. Raises Fails."""
        deadline = self.begun + (PAGE_S + installs * INSTALL_S) * patience()
        while "password:" not in self.output():
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise Fails(f"no page after {time.monotonic() - self.begun:.0f} s:\n{self._all_words()}")
            time.sleep(0.2)
        password = self.output().partition("password:")[2].split()[0]
        Person(f"http://127.0.0.1:{self.port}", password).works(deadline)

    def refusal(self, alone: bool = True) -> str:
        """Wait for its end and return the last line.

        Raises:
            Fails: it goes on, ends late, prints a traceback, or leaves processes behind (only checked where no other process uses the
                folder).
        """
        try:
            code = self.process.wait(REFUSAL_S * patience())
        except subprocess.TimeoutExpired:
            self.stop()
            raise Fails(f"it did not end within {REFUSAL_S:.0f} s:\n{self._all_words()}") from None
        words = self.output()
        if code == 0 or "Traceback" in words:
            raise Fails(f"it ended with {code}:\n{words}")
        if alone:
            self._require_nothing_left()
        lines = [line for line in words.splitlines() if line.strip() and not line.startswith("make:")]
        return lines[-1] if lines else ""

    def stop(self) -> None:
        """Press Ctrl-C. Raises Fails where something goes on."""
        os.killpg(self.process.pid, signal.SIGINT)
        try:
            self.process.wait(STOP_S * patience())
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            raise Fails(f"Ctrl-C did not end it within {STOP_S:.0f} s:\n{self._all_words()}") from None
        self._require_nothing_left()

    def _require_nothing_left(self) -> None:
        deadline = time.monotonic() + 10 * patience()
        while left := processes_naming(self.machine.data()):
            if time.monotonic() > deadline:
                raise Fails(f"processes of {self.machine.data()} go on: {left}")
            time.sleep(0.2)

    def _all_words(self) -> str:
        logs = [f"{log.name}: {log.read_text(errors='replace')[-2000:]}" for log in sorted((self.machine.data() / "log").glob("*.log"))]
        return "\n".join([self.output()[-4000:], *logs])


def processes_naming(folder: Path) -> dict[int, str]:
    """Return processes whose arguments or environment name a folder."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            words, settings = (entry / "cmdline").read_bytes(), (entry / "environ").read_bytes()
        except OSError:
            continue
        if os.fsencode(folder) in words + b"\0" + settings and int(entry.name) != os.getpid():
            found[int(entry.name)] = words.replace(b"\0", b" ").decode(errors="replace")
    return found


class Person:
    """A user at a browser, who signs in and uploads a file to the first participant."""

    def __init__(self, address: str, password: str) -> None:
        self._address, self._password = address, password
        self._browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(http.cookiejar.CookieJar()))

    def works(self, deadline: float) -> None:
        """Sign in, wait for P1's page, and upload a session. Raises Fails."""
        self._post("/sign-in", email="clinician@demo.example", password=self._password)
        while "There is none yet" in self._page("/participants/P1/upload", instead="There is none yet"):
            if time.monotonic() > deadline:
                raise Fails("P1 has no visit to upload to")
            time.sleep(0.5)
        page = self._post("/participants/P1/upload", controller="random", file=SESSION)
        if "newcomer.csv" not in page or "Traceback" in page:
            raise Fails(f"the upload was answered: {re.sub('<[^>]+>', ' ', page)[-2000:]}")

    def _page(self, path: str, instead: str) -> str:
        """Return a page's text, or other words where there is no such page yet."""
        try:
            with self._browser.open(self._address + path, timeout=60) as answer:
                return str(answer.read().decode())
        except urllib.error.HTTPError:
            return instead

    def _post(self, path: str, **fields: str) -> str:
        """Send a form as a browser does; `file` goes as a file."""
        mark = uuid.uuid4().hex
        parts = []
        for name, value in fields.items():
            named = f'name="{name}"; filename="newcomer.csv"' if name == "file" else f'name="{name}"'
            parts.append(f"--{mark}\r\nContent-Disposition: form-data; {named}\r\n\r\n{value}\r\n")
        body = ("".join(parts) + f"--{mark}--\r\n").encode()
        headers = {"Content-Type": f"multipart/form-data; boundary={mark}", "Sec-Fetch-Site": "same-origin", "Accept": "text/html"}
        request = urllib.request.Request(self._address + path, body, headers)
        try:
            with self._browser.open(request, timeout=120) as answer:
                return str(answer.read().decode())
        except urllib.error.HTTPError as error:
            raise Fails(f"POST {path} was answered {error.code}: {error.read().decode(errors='replace')[-1000:]}") from error


def take_over(installed: Path, clone: Path) -> None:
    """Give a clone the virtual environment of another one, under its own paths: what `make install` would make, in a second."""
    subprocess.run(["cp", "-al", str(installed / ".venv"), str(clone / ".venv")], check=True)
    site = next((clone / ".venv" / "lib").glob("python*")) / "site-packages"
    naming = [*(clone / ".venv" / "bin").iterdir(), clone / ".venv" / "pyvenv.cfg", *site.glob("*betaloop*"), *site.glob("betaloop*/*")]
    for path in naming:
        if path.is_file() and not path.is_symlink() and os.fsencode(installed) in (content := path.read_bytes()):
            mode = path.stat().st_mode
            path.unlink()  # the other clone has the same file
            path.write_bytes(content.replace(os.fsencode(installed), os.fsencode(clone)))
            path.chmod(mode)
    for cached in (site / "__pycache__").glob("*betaloop*"):
        cached.unlink()
    (clone / ".venv" / ".installed").touch()
