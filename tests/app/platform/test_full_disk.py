"""A service on disks that are really full: reported in words, nothing acknowledged lost, and over as soon as there is room."""

from __future__ import annotations

import json
import os
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx2 as httpx
import pytest

from app.accounts.service import UNDECIDED_WINDOW
from benchmarks.installed.installation import PASSWORD, STARTED_S, Installation
from benchmarks.installed.writers import PEOPLE, Writers, make_study, what_is_wrong
from tests.app.platform.test_healing import patience
from tests.app.platform.upkeep.small_disks import fill, grow, make_room, small_disk

ADMIN = next(iter(PEOPLE))
SAID = {503: "The database does not answer for the moment.", 507: "There is no room left on the disk."}
FULL_S, AWAY_S = 3.0, 1.5
"""For so long everything is asked of a service whose disk is full, and whose database is away in addition."""
RESUMED_S = 100.0
"""Uploads that were cut short are looked for once a minute."""


@dataclass
class Asked:
    """Callers of pages and of the interface.

    Attributes:
        answers: how often each status came. wrong: answers that are neither right nor say in words what is full or away.
    """

    page: httpx.Client
    api: httpx.Client
    answers: Counter[int] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def everything(self, seconds: float) -> None:
        """Sign in, read and upload, on pages and interface, for so long."""
        until, form = time.monotonic() + seconds, {"visit": "1", "controller": "random"}
        while time.monotonic() < until:
            self.look(self.page.post("/sign-in", data={"email": ADMIN, "password": PASSWORD}))
            noise = {"file": ("s.csv", os.urandom(1 << 18).hex().encode())}
            for path in ("/", "/participants/S1/visits"):
                self.look(self.page.get(path))
            self.look(self.page.post("/participants/S1/upload", data=form, files=noise))
            self.look(self.api.get("/api/v1/participants"))
            self.look(self.api.post("/api/v1/uploads", data=form | {"participant": "S1"}, files=noise))

    def look(self, answer: httpx.Response) -> None:
        """Count an answer, and keep one that is wrong."""
        status = answer.status_code
        self.answers[status] += 1
        if status == 429 and "are waiting for an answer" in answer.text:
            return  # the right password, too often without a verdict; never called failed
        in_words = status in SAID and SAID[status] in answer.text and ("retry-after" in answer.headers) == (status == 503)
        # what is uploaded is noise and no table: where it could be kept and read, that is the answer
        if not (in_words or answer.is_success or status in (303, 422)):
            self.wrong.append(f"{answer.request.method} {answer.request.url.path}: {status} {answer.text[:300]}")


@contextmanager
def callers(base: str, token: str) -> Iterator[Asked]:
    """Open a signed-in browser, and a program with a token."""
    browser = {"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}
    with (
        httpx.Client(base_url=base, headers=browser, timeout=60) as page,
        httpx.Client(base_url=base, headers={"Authorization": f"Bearer {token}"}, timeout=60) as api,
    ):
        until = time.monotonic() + UNDECIDED_WINDOW.total_seconds() + patience()
        while page.post("/sign-in", data={"email": ADMIN, "password": PASSWORD}).status_code != 303:
            assert time.monotonic() < until, "tries without a verdict lock nobody out for longer"
            time.sleep(5)  # each one that is refused counts against where it came from
        yield Asked(page, api)


@contextmanager
def installed_on_small_disks() -> Iterator[tuple[Installation, Path, Path]]:
    """Install with the database and log on one disk of 256 MiB, and the stored files on another of 24."""
    with ExitStack() as held:
        folder = Path(held.enter_context(tempfile.TemporaryDirectory(prefix="betaloop-full-", dir="/tmp")))
        folder.chmod(0o711)
        data = held.enter_context(small_disk(folder / "data", "256m"))
        stored = held.enter_context(small_disk(data / "files", "24m", "0700"))
        installed = Installation(data)
        try:
            yield installed, data, stored
        finally:
            for process in installed.processes.values():
                process.kill()
                process.wait()
            make_room(data)
            installed.database.remove()


def seconds_until_healthy(base: str) -> float:
    """Wait until the service is healthy by itself; return the seconds."""
    begun = time.monotonic()
    while httpx.get(f"{base}/readyz", timeout=patience()).status_code != 200:
        assert time.monotonic() - begun < patience()
        time.sleep(0.05)
    return time.monotonic() - begun


def filled(installed: Installation, disks: Sequence[Path], token: str, end_the_database: bool) -> tuple[Counter[int], float]:
    """Fill disks, ask for everything, and make room again; answers, and the seconds until the service is healthy."""
    with callers(installed.bases[0], token) as asked:
        for disk in disks:
            fill(disk)
        asked.everything(FULL_S)
        if end_the_database:
            os.kill(installed.database.pid(), signal.SIGKILL)
            asked.everything(AWAY_S)
        for disk in disks:
            make_room(disk)
        seconds = seconds_until_healthy(installed.bases[0])
    assert not asked.wrong
    assert set(asked.answers) >= ({503, 507} if end_the_database else {200, 507})
    return asked.answers, seconds


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_full_disks_are_told_in_words_and_leave_nothing_wrong_behind() -> None:
    answers, longest = Counter[int](), 0.0
    with installed_on_small_disks() as (installed, data, stored):
        tokens = installed.add_people(PEOPLE)
        installed.start("web 1")
        installed.wait_until("the first answer", installed.webs_are_ready, STARTED_S)
        study = make_study(installed, tokens)
        writers = Writers(installed, tokens[ADMIN], study, pause_s=0.05)
        writers.stop_jobs()
        writers.start()
        for disks, end_the_database in (([stored], False), ([data], True), ([stored, data], True)):
            found, seconds = filled(installed, disks, tokens[ADMIN], end_the_database)
            answers, longest = answers + found, max(longest, seconds)
            before = len(writers.said.uploads)
            installed.wait_until("uploads to be acknowledged again", lambda: len(writers.said.uploads) > before, patience())  # noqa: B023
        writers.stop()
        assert writers.said.answers["507"], "those who write met it too"
        with callers(installed.bases[0], tokens[ADMIN]):
            pass  # a user who tried meanwhile is let in
        received = "select id from upload where status = 'received'"
        installed.wait_until("what was cut short to be read", lambda: installed.ask(received) == [], RESUMED_S)
        assert what_is_wrong(installed, writers.said, study) == []
        grow(data, "2g")  # for the doctor asks for more room than this disk ever had
        installed.stop()
        for command in (["doctor", "--hashes"], ["audit", "verify"]):
            judged = installed.run(*command)
            assert judged.returncode == 0, judged.stdout + judged.stderr
    figures = {"acknowledged": str(writers.said), "healthy_after_s": round(longest, 2), "answers": dict(sorted(answers.items()))}
    print(json.dumps(figures))  # noqa: T201 - for docs/reliability.md, shown by `pytest -s`
