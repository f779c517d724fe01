"""Large pages of the process that forks readers: its memory moves to them unchanged and grows no larger."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

MEMORY = """
import json
from pathlib import Path
from app.platform.jobs.children import fork_server

def pages() -> dict[str, int]:
    return {name: int(size.split()[0]) for name, _, size in (line.partition(":") for line in Path("/proc/self/smaps_rollup").open())
            if name in ("Rss", "AnonHugePages")}

held = [str(number) * 20 for number in range(400_000)]
before, moved, after = pages(), fork_server.use_large_pages(), pages()
print(json.dumps({"moved": moved, "before": before, "after": after, "same": held == [str(number) * 20 for number in range(400_000)]}))
"""


def test_what_a_process_holds_moves_to_large_pages_unchanged_and_takes_no_more_room() -> None:
    found = json.loads(subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True).stdout)
    if not found["moved"]:
        pytest.skip("this system does not move memory to large pages")
    assert found["same"]
    assert found["after"]["AnonHugePages"] - found["before"]["AnonHugePages"] > 30_000  # kB, of at least 60 000
    assert found["after"]["Rss"] < 1.1 * found["before"]["Rss"]
