"""Cost of the suite: a server that a test leaves behind counts, to that test and to the whole."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BURNED_S = 0.8
SERVER = f"""
import pathlib, time
while time.process_time() < {BURNED_S}: pass
pathlib.Path("burned").touch()
time.sleep(2)
"""
TESTS = """
import pathlib, subprocess, sys, time
def test_dear():
    subprocess.run(["sh", "-c", '"$0" server.py > server.log 2>&1 &', sys.executable], check=True, start_new_session=True)
    while not pathlib.Path("burned").exists(): time.sleep(0.05)
def test_cheap():
    pass
"""


def test_a_server_that_lost_its_parent_is_counted_to_the_test_that_started_it(tmp_path: Path) -> None:
    (tmp_path / "server.py").write_text(SERVER)
    (tmp_path / "test_costs.py").write_text(TESTS)
    (tmp_path / "Makefile").write_text(f"test:\n\t{sys.executable} -m pytest -q -p no:cacheprovider test_costs.py\n")
    run = [sys.executable, str(ROOT / "benchmarks" / "suite.py"), str(tmp_path)]
    told = subprocess.run(run, capture_output=True, text=True, check=True, timeout=300).stdout
    whole = re.search(r": 2 tests, ([0-9.]+) s of processor", told)
    dear, cheap = (re.search(rf"([0-9.]+) s  test_costs.py::{name}\n", told) for name in ("test_dear", "test_cheap"))
    assert whole and dear and cheap, told  # noqa: PT018
    assert float(whole[1]) > float(dear[1]) >= 0.9 * BURNED_S
    assert float(cheap[1]) < 0.5 * BURNED_S
