"""What `make bench` runs: every file in `benchmarks/` is a script that knows `--quick`; what scripts share lies in `benchmarks/support`."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = sorted((ROOT / "benchmarks").glob("*.py"))


def options(source: str) -> set[str]:
    """Options that a script's parser is given."""
    calls = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)]
    return {str(a.value) for c in calls if c.func.attr == "add_argument" for a in c.args if isinstance(a, ast.Constant)}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_every_script_can_be_run_in_its_quick_form(script: Path) -> None:
    source = script.read_text()
    assert re.search(r'^if __name__ == "__main__":$', source, re.MULTILINE), "a module without a main part belongs into benchmarks/support"
    assert "--quick" in options(source)


def test_what_scripts_share_is_no_script() -> None:
    shared = [p for p in (ROOT / "benchmarks" / "support").glob("*.py") if '__name__ == "__main__"' in p.read_text()]
    assert shared == []


@pytest.mark.parametrize("script", ["ope", "population", "dlsm_selection"])
def test_a_script_finds_what_it_shares_wherever_it_is_called_from(script: str, tmp_path: Path) -> None:
    called = [sys.executable, str(ROOT / "benchmarks" / f"{script}.py"), "--help"]
    found = subprocess.run(called, cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=100)
    assert found.returncode == 0, found.stderr
    assert "--quick" in found.stdout
