"""Scripts of `make bench`: every file in `benchmarks/` and `benchmarks/evaluation/` knows `--quick`; shared code is in `benchmarks/support`
and `benchmarks/installed`.
"""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = sorted([*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "benchmarks" / "evaluation").glob("*.py")])


def options(source: str) -> set[str]:
    """List the options of a script's parser."""
    calls = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)]
    return {str(a.value) for c in calls if c.func.attr == "add_argument" for a in c.args if isinstance(a, ast.Constant)}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_every_script_can_be_run_in_its_quick_form(script: Path) -> None:
    source = script.read_text()
    assert re.search(r'^if __name__ == "__main__":$', source, re.MULTILINE), "a module without a main part belongs into benchmarks/support"
    assert "--quick" in options(source)
    assert source.endswith("    run_benchmark(main)\n"), "without it `--write NAME` writes no page of docs/results"


def test_what_scripts_share_is_no_script() -> None:
    shared = [p for p in (ROOT / "benchmarks" / "support").glob("*.py") if '__name__ == "__main__"' in p.read_text()]
    assert shared == []


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_a_script_imports_only_what_is_there_when_it_is_called(script: Path) -> None:
    """A script finds `support` and `installed` next to it; one of `benchmarks.evaluation`, called from the root, finds `benchmarks`."""
    tree = ast.parse(script.read_text())
    modules = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module}
    shared = {m for m in modules if m.split(".")[0] in ("support", "installed", "benchmarks")}
    above = "benchmarks." if script.parent.name == "evaluation" else ""
    assert all(m.startswith((f"{above}support.", f"{above}installed.")) for m in shared), shared
    assert all((ROOT / "benchmarks" / f"{m.removeprefix(above).replace('.', '/')}.py").exists() for m in shared)


def is_there(module: str, name: str) -> bool:
    """Check whether `from module import name` finds something."""
    found = importlib.import_module(module)
    return hasattr(found, name) or (hasattr(found, "__path__") and find_spec(f"{module}.{name}") is not None)


def test_what_benchmarks_import_of_the_service_is_there() -> None:
    nodes = [(p, n) for p in sorted((ROOT / "benchmarks").rglob("*.py")) for n in ast.walk(ast.parse(p.read_text()))]
    wanted = [(p, n.module, a.name) for p, n in nodes if isinstance(n, ast.ImportFrom) and n.module and not n.level for a in n.names]
    ours = [(p, module, name) for p, module, name in wanted if module.split(".")[0] in ("app", "ml")]
    assert len(ours) > 100
    assert [f"{p.name}: {module} has no {name}" for p, module, name in ours if not is_there(module, name)] == []


@pytest.mark.parametrize("script", ["ope", "population", "beta_gaps"])
def test_a_script_finds_what_it_shares_wherever_it_is_called_from(script: str, tmp_path: Path) -> None:
    # app and ml alone are on the path, as where betaloop is installed: the root itself would hide an import that needs it
    path = tmp_path / "path"
    path.mkdir()
    for package in ("app", "ml"):
        (path / package).symlink_to(ROOT / package)
    assert_shows_its_options([str(ROOT / "benchmarks" / f"{script}.py")], tmp_path, str(path))


def test_a_benchmark_of_evaluation_is_a_module_of_the_root() -> None:
    assert_shows_its_options(["-m", "benchmarks.evaluation.verdicts"], ROOT, "")


def assert_shows_its_options(called: list[str], folder: Path, path: str) -> None:
    """Call a script with `--help` in a folder, with these folders alone on the path of modules."""
    environment = {"PYTHONPATH": path}
    found = subprocess.run([sys.executable, *called, "--help"], cwd=folder, env=environment, capture_output=True, text=True, timeout=100)
    assert found.returncode == 0, found.stderr
    assert "--quick" in found.stdout
