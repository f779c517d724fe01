"""Pages of docs/results are written by the benchmark that prints them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.support.results import emit, run_benchmark


def test_a_page_has_the_command_the_commit_and_what_was_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["benchmarks/growth.py", "--quick", "--write", "a-page"])

    def main() -> None:
        emit(f"{sys.argv[1:]}\n")
        emit("37 sessions   5.2 s\n")

    run_benchmark(main, tmp_path)
    page = (tmp_path / "a-page.md").read_text()
    assert page.startswith("# A page\n\n`python benchmarks/growth.py --quick --write a-page` printed this at commit ")
    assert "```\n['--quick']\n37 sessions   5.2 s\n```" in page


def test_a_run_that_fails_leaves_the_page_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.md").write_text("earlier")
    monkeypatch.setattr(sys, "argv", ["growth.py", "--write", "a"])

    def main() -> None:
        emit("half a table")
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        run_benchmark(main, tmp_path)
    assert (tmp_path / "a.md").read_text() == "earlier"


@pytest.mark.parametrize("name", [[], ["--quick"], ["../x"], ["A b"]])
def test_a_name_that_is_no_page_is_refused(name: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["growth.py", "--write", *name])
    with pytest.raises(SystemExit, match="needs the name of a page"):
        run_benchmark(lambda: emit("x"), tmp_path)
    assert list(tmp_path.iterdir()) == []
