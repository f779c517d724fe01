"""The hazard log: every hazard has a test, every mark names a hazard, and the page is current."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

from app.tablet.hazards import HAZARDS, PAGE, ROOT, Likelihood, marked_tests, page

MEND = "run `python -m app.tablet.hazards`"


def test_every_hazard_has_a_test_and_every_mark_names_a_hazard() -> None:
    numbers = [hazard.number for hazard in HAZARDS]
    assert numbers == [f"H{k:02}" for k in range(1, len(HAZARDS) + 1)], "numbers are never given again"
    tests = marked_tests(ROOT / "tests")
    assert sorted(tests) == numbers


def test_the_page_is_made_of_the_hazards_and_their_tests() -> None:
    assert PAGE.read_text("utf-8") == page(marked_tests(ROOT / "tests")), MEND


def test_a_control_lowers_the_likelihood_or_is_none() -> None:
    order = list(Likelihood)
    assert all(order.index(hazard.after) < order.index(hazard.before) or hazard.before is Likelihood.P1 for hazard in HAZARDS)
    assert all(hazard.control and hazard.residual and hazard.harms for hazard in HAZARDS)


def test_no_hazard_rests_on_tests_that_the_usual_run_leaves_out() -> None:
    for number, names in marked_tests(ROOT / "tests").items():
        assert any(not _slow(*name.split("::")) for name in names), number


def _slow(path: str, name: str) -> bool:
    tree = ast.parse((ROOT / path).read_text("utf-8"))
    found = next(node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name == name)
    return any("slow" in ast.unparse(one) or "skip" in ast.unparse(one) for one in found.decorator_list)


def test_a_hazard_whose_tests_are_all_skipped_fails_the_run(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text((ROOT / "tests" / "hazard_marks.py").read_text("utf-8"))
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n    hazard(number): x\n")
    test = tmp_path / "test_one.py"
    call = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(test)]
    for body, code in [("pytest.skip('no')", 1), ("pass", 0)]:
        test.write_text(f"import pytest\n\n\n@pytest.mark.hazard('H01')\ndef test_one():\n    {body}\n")
        ran = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert ran.returncode == code, ran.stdout
        assert ("no test passed for the hazards H01" in ran.stdout) == bool(code)
