"""The report of an upload: one line for each file, with what was understood, sessions and problems; problems and a single file are open."""

from __future__ import annotations

import re
from html import unescape

from fastapi.testclient import TestClient

from tests.app.ingest.conftest import device_zip
from tests.app.words import above_fold

FOLD = re.compile(r'<li><details class="file"( open)?>\s*<summary><b>([^<]*)</b>(.*?)</summary>', re.S)


def lines(page: str) -> dict[str, tuple[bool, str]]:
    """Return by name of a file, inner ones included: whether it is open, and its line without markup."""
    return {name: (bool(opened), " ".join(re.sub("<[^>]*>", " ", rest).split())) for opened, name, rest in FOLD.findall(unescape(page))}


def test_every_file_is_a_line_and_only_a_problem_stands_open(browser: TestClient, participant_code: str, table: bytes) -> None:
    files = [("good.csv", table), ("bad.csv", b"a,b\n1,2\n"), ("noise.bin", b"\x00\x01")]
    fields = {"visit": "1", "controller": "cdbs"}
    page = browser.post(f"/participants/{participant_code}/upload", data=fields, files=[("file", f) for f in files]).text
    told = lines(page)
    assert {name: opened for name, (opened, _) in told.items()} == {"good.csv": False, "bad.csv": True, "noise.bin": True}
    assert re.fullmatch(r"file \d+ read 4 to look at table, \d+ B · 1 session · 50 rows of 2 s: .*", told["good.csv"][1]), told["good.csv"]
    assert re.match(r"file \d+ columns not known 1 problem unreadable, 8 B", told["bad.csv"][1])
    assert "1 problem" in told["noise.bin"][1]
    seen = above_fold(page)
    assert "Removed" not in seen
    assert "SHA-256 of the original" in page
    stored = lines(browser.get("/uploads/1").text)
    assert len(stored) == 3, "the stored report is folded in the same way"
    assert sorted(opened for opened, _ in stored.values()) == [False, True, True]


def test_the_files_of_an_archive_are_lines_within_its_line(browser: TestClient, participant_code: str, table: bytes) -> None:
    given = [("file", ("device.zip", device_zip())), ("file", ("steps.csv", table))]
    page = browser.post(f"/participants/{participant_code}/upload", data={"visit": "1", "controller": "cdbs"}, files=given).text
    told = lines(page)
    opened, line = told.pop("device.zip")
    assert told.pop("steps.csv")[0] is False
    assert not opened
    assert re.search(r"\d+ files in it", line)
    assert "1 session" in line
    assert len(told) >= 3
    assert not any(opened for opened, _ in told.values())
    assert not any(name in above_fold(page) for name in told), "inner files are seen once their archive is opened"
    assert "<h3>" not in page


def test_a_single_file_stands_open_and_what_is_in_it_does_not(browser: TestClient, participant_code: str) -> None:
    given = {"file": ("device.zip", device_zip())}
    page = browser.post(f"/participants/{participant_code}/upload", data={"visit": "1", "controller": "cdbs"}, files=given).text
    told = lines(page)
    assert told.pop("device.zip")[0] is True
    assert len(told) >= 3
    assert not any(opened for opened, _ in told.values())
