"""The service in a thread and a real Chromium before it; everything that goes wrong on a page is written down."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from fastapi.testclient import TestClient

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
PASSWORD = "correct horse battery"
PATIENCE_MS = 120_000
"""Longest wait for a page, or a part of it: on a machine that is busy with other work, half a minute was too short."""
DRAWN_FOR_PAPER = """() => [...document.querySelectorAll("figure[data-chart]")].every((figure) => figure.dataset.drawn === "failed"
  || (figure.dataset.drawn === "yes" && figure.querySelector(".plot").layout?.autosize === false))"""
CLIPPED = """() => {
  const past = (e, within) => Math.round(e.getBoundingClientRect().right - within.getBoundingClientRect().right);
  const told = (e, within, what) => (e.getBoundingClientRect().width && past(e, within) > 0 ? [`${what} by ${past(e, within)} px`] : []);
  const cards = [...document.querySelectorAll("main .card")].flatMap((card) =>
    [...card.querySelectorAll("table, figure, svg.drawing, dl, pre")].flatMap((e) => told(e, card, `${e.tagName} past its card`)));
  const charts = [...document.querySelectorAll("figure[data-chart]")].flatMap((figure) => {
    if (figure.dataset.drawn === "failed") return [`${figure.id} was not drawn`];
    return [...figure.querySelectorAll(".main-svg")].flatMap((e) =>
      [".plot", "main"].flatMap((name) => told(e, e.closest(name), `${figure.id} past ${name}`)));
  });
  return [...cards, ...charts];
}"""
"""Tables and boxes past their card; charts past the place that would cut them off."""
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
]  # fmt: skip


@dataclass
class Watched:
    """A browser window, and what it complained about.

    Attributes:
        errors: console errors and warnings, and exceptions of scripts.
        foreign: addresses outside the service that the page asked for.
    """

    page: Any
    address: str
    errors: list[str] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)

    def open(self, path: str) -> None:
        """Open a path of the service."""
        answer = self.page.goto(self.address + path)
        assert answer.status == 200, f"{path}: {answer.status}"

    def sign_in(self, email: str = "admin@clinic.example", password: str = PASSWORD) -> None:
        """Sign in through the form."""
        self.open("/sign-in")
        self.page.fill("[name=email]", email)
        self.page.fill("[name=password]", password)
        self.page.click("main button")
        self.page.wait_for_selector("a.who")

    def signed_in(self, email: str = "admin@clinic.example", password: str = PASSWORD) -> None:
        """Sign in without the form's page and the one after it, for tests of something else: the two take a second of a processor."""
        entered = {"email": email, "password": password}
        answer = self.page.context.request.post(f"{self.address}/sign-in", form=entered, headers={"Accept": "text/html"}, max_redirects=0)
        assert answer.status == 303, answer.status

    def charts_drawn(self) -> int:
        """Scroll every chart into view and wait until it is drawn; how many there are, less those in a closed fold, which are not drawn."""
        self.page.wait_for_load_state()  # after a click the page may be there in part
        found = self.page.query_selector_all("figure[data-chart]")
        charts = [chart for chart in found if chart.evaluate("(e) => !e.closest('details:not([open])')")]
        for chart in charts:
            chart.scroll_into_view_if_needed()
            self.page.wait_for_selector(f"#{chart.get_attribute('id')}[data-drawn=yes] .main-svg", timeout=60_000)
        return len(charts)

    def settled(self) -> None:
        """Wait for all that comes after the page: charts, and parts that are fetched."""
        self.charts_drawn()
        self.page.wait_for_function("() => ![...document.querySelectorAll('[data-late]')].some((e) => e.dataset.late === '')")

    def on_paper(self) -> list[str]:
        """Draw every chart for paper, as before printing, which this browser must be asked for; return what is wider than its container."""
        self.page.evaluate("() => dispatchEvent(new Event('beforeprint'))")
        self.page.wait_for_function(DRAWN_FOR_PAPER)
        found: list[str] = self.page.evaluate(CLIPPED)
        return found


def program() -> str:
    """Return the path of Chromium. Skips where there is none."""
    path = os.environ.get("BETALOOP_CHROMIUM") or next(filter(None, map(shutil.which, PROGRAMS)), None)
    if path is None:
        pytest.skip("no Chromium here: install it, or name its program in BETALOOP_CHROMIUM")
    return path


def kill_browser(profile: str) -> None:
    """End the browser that has this profile as an empty battery would: at once, and without a word to it."""
    found = 0
    for folder in Path("/proc").iterdir():
        if not folder.name.isdecimal():
            continue
        try:
            if f"--user-data-dir={profile}" in (folder / "cmdline").read_bytes().decode():
                os.kill(int(folder.name), signal.SIGKILL)
                found += 1
        except (FileNotFoundError, ProcessLookupError):
            continue  # it ended meanwhile
    assert found, f"no browser has the profile {profile}"


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A running Chromium, for one module: its event loop must not outlive the browser tests. Skips where there is none."""
    path = program()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield browser
        browser.close()


@contextmanager
def serving(app: Any) -> Iterator[str]:
    """Serve an app in a thread, on the database in use; yield its address."""
    server = uvicorn.Server(uvicorn.Config(app, host="127.0.0.1", port=0, log_level="warning"))
    thread = threading.Thread(target=server.run)
    thread.start()
    deadline = time.monotonic() + 180
    while not server.started:
        assert thread.is_alive(), "the service ended before it listened"
        assert time.monotonic() < deadline, "the service did not listen within 180 s"
        time.sleep(0.05)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join(timeout=30)
    assert not thread.is_alive()


@contextmanager
def windows(chromium: Any, address: str) -> Iterator[Callable[..., Watched]]:
    """Open windows of a size and colour scheme on a service."""
    contexts = []

    def make(width: int = 1400, height: int = 900, scheme: str = "light") -> Watched:
        context = chromium.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
        context.set_default_timeout(PATIENCE_MS)
        contexts.append(context)
        watched = Watched(context.new_page(), address)
        watched.page.on("console", lambda m: watched.errors.append(m.text) if m.type in ("error", "warning") else None)
        watched.page.on("pageerror", lambda e: watched.errors.append(str(e)))
        watched.page.on("request", lambda r: watched.foreign.append(r.url) if not r.url.startswith((address, "data:", "blob:")) else None)
        return watched

    yield make
    for context in contexts:
        context.close()


@pytest.fixture
def address(service_app) -> Iterator[str]:  # type: ignore[no-untyped-def]
    """Address of the service; it runs in a thread on the test's database."""
    with serving(service_app) as found:
        yield found


@pytest.fixture
def window(chromium: Any, address: str, client: TestClient) -> Iterator[Callable[..., Watched]]:
    """Open windows of a size and colour scheme; `client` has made the administrator."""
    with windows(chromium, address) as make:
        yield make


@pytest.fixture
def table() -> bytes:
    """A table of 40 steps after a full window; three steps without beta."""
    rows = [f"{2 * i},{'' if 11 <= i <= 13 else 1 + 0.5 * (i % 3)},{0.5 + 0.01 * (i % 5)}" for i in range(-9, 41)]
    return "\n".join(["t_s,beta,amplitude_fraction", *rows]).encode()


@pytest.fixture
def study_world(client: TestClient, participant_code: str, table: bytes) -> list[int]:
    """Participant P1 with two sessions of cDBS and one of the random controller; their numbers."""
    ids = []
    for i, controller in enumerate(["cdbs", "random", "cdbs"]):
        data = {"participant": participant_code, "visit": "1", "controller": controller}
        # another beta in one row makes another recording
        content = table + f"\n{82},{1 + i},0.5".encode()
        answer = client.post("/api/v1/uploads", data=data, files={"file": (f"{i}.csv", content)})
        assert answer.status_code == 201, answer.text
        ids.append(int(answer.json()["sessions"][0]["id"]))
        client.put(f"/api/v1/sessions/{ids[-1]}/qoc", json={"grasp_hz": 2.0 + i, "rating": 5 + i, "tremor_percent": 10.0 * i})
    return ids
