"""Contents that a printed page must not lose: every file of a report, every row that a count includes, and where samples are."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient

from app.overview.overview_web import SOON
from tests.app.ingest.safety.planted import rcs_zip
from tests.browser import tour
from tests.browser.conftest import Watched
from tests.browser.test_accessibility import SHEET

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SEEN = "() => document.querySelector('main').innerText"
"""Text of the page: nothing of a closed fold, nothing that a style hides."""
UNCUT = "() => [...document.querySelectorAll('.file > summary > .line')].every((line) => line.scrollWidth <= line.clientWidth + 1)"


@pytest.fixture
def printed(window: Callable[..., Watched]) -> Watched:
    """A window as wide as a sheet, signed in, with the styles of paper."""
    watched = window(SHEET, 900, "light")
    watched.signed_in()
    watched.page.emulate_media(media="print")
    return watched


def test_a_printed_report_names_every_file_and_what_was_read_of_it(
    client: TestClient, participant_code: str, table: bytes, printed: Watched
) -> None:
    files = [("file", ("good.csv", table)), ("file", ("bad.csv", b"x,y\n1,2")), ("file", ("device.zip", rcs_zip()))]
    answer = client.post("/api/v1/uploads", data={"participant": participant_code, "visit": "1", "controller": "cdbs"}, files=files)
    printed.open(f"/uploads/{answer.json()['id']}")
    assert printed.on_paper() == []
    names = printed.page.locator("details.file > summary > b")
    shown = [(names.nth(k).inner_text(), names.nth(k).is_visible()) for k in range(names.count())]
    assert len(shown) > 3, "also those inside of the archive"
    assert [name for name, visible in shown if not visible] == []
    assert {"csv.csv", "unreadable.csv"} < {name for name, _ in shown}, "names as they are kept"
    assert printed.page.evaluate(UNCUT)


def test_a_printed_home_counts_the_visits_that_it_does_not_list(client: TestClient, participant_code: str, printed: Watched) -> None:
    codes = [participant_code, *(f"Q{k}" for k in range(SOON + 1))]
    for code in codes[1:]:
        assert client.post("/api/v1/participants", json={"code": code}).status_code == 201
    for k, code in enumerate(codes):
        day = str(dt.datetime.now(dt.UTC).date() + dt.timedelta(days=2 + k))
        assert client.post(f"/api/v1/participants/{code}/visits", json={"number": 40, "date": day}).status_code == 201
    printed.open("/")
    assert f"And {len(codes) - SOON} later visits" in printed.page.evaluate(SEEN)
    assert printed.on_paper() == []
    rows = printed.page.locator("#board tbody tr")
    assert [rows.nth(k).is_visible() for k in range(rows.count())] == [True] * SOON


def test_samples_that_have_not_come_are_told_on_paper(client: TestClient, participant_code: str, printed: Watched) -> None:
    data = {"participant": participant_code, "visit": "1", "controller": "cdbs"}
    session = client.post("/api/v1/uploads", data=data, files={"file": ("tour.csv", tour.samples())}).json()["sessions"][0]["id"]
    printed.page.emulate_media(media="screen")
    printed.page.set_viewport_size({"width": SHEET, "height": 200})
    printed.open(f"/sessions/{session}")
    line, figure = printed.page.locator("#signal-card .print-only"), printed.page.locator("#signal")
    assert not line.is_visible()
    assert printed.page.get_attribute("#signal", "data-drawn") is None
    printed.page.emulate_media(media="print")
    assert f"/sessions/{session}/signal" in line.inner_text()
    assert line.is_visible()
    assert not figure.is_visible()
    printed.page.emulate_media(media="screen")
    figure.scroll_into_view_if_needed()
    printed.page.wait_for_selector("#signal[data-drawn=yes]")
    printed.page.emulate_media(media="print")
    assert figure.is_visible()
    assert not line.is_visible()
