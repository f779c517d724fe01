"""Start without the learners: compute modules are named by strings, and `scipy` loads its parts where they are first used."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def loaded(code: str) -> set[str]:
    """List the modules that a fresh interpreter has loaded after some code."""
    script = f"{code}\nimport sys\nprint(' '.join(sorted(sys.modules)))"
    return set(subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=True, capture_output=True, text=True).stdout.split())


SLOW_TO_LOAD = {
    "torch", "numba", "scipy.stats", "scipy.signal", "scipy.optimize", "scipy.spatial", "fpdf", "authlib", "fsspec", "pyarrow", "pandas",
}  # fmt: skip
"""Each takes a third of a second or 25 MB or more of every start, for what few of the processes do."""


def test_the_web_process_never_loads_torch_and_starts_without_what_it_may_never_need() -> None:
    modules = loaded("from app.main import create_app; create_app().openapi()")
    assert "app.pipeline.kinds" in modules
    assert modules & SLOW_TO_LOAD == set()
    assert not {m for m in modules if m.startswith("app.") and m.endswith("compute")}


def test_a_command_starts_without_what_it_may_never_need() -> None:
    modules = loaded("import app.cli")
    assert "ml.formats.registry" in modules
    assert "ml.formats.rcs" not in modules
    assert modules & SLOW_TO_LOAD == set()


def test_the_process_whose_forks_decode_has_loaded_what_decoders_need() -> None:
    modules = loaded("from app.ingest.uploads.compute import prepare; prepare()")
    assert modules >= {"numba", "scipy.signal", "scipy.ndimage", "scipy.linalg"}


def test_the_table_of_algorithms_is_read_without_torch() -> None:
    modules = loaded("from ml.rl import ALGORITHMS; assert ALGORITHMS['iql'].title")
    assert "torch" not in modules


@pytest.mark.parametrize("kind", ["pipeline", "next_generation", "evaluate", "train", "distill", "threshold_rule"])
def test_every_function_that_a_kind_names_is_there(kind: str) -> None:
    from app.platform.jobs import registry

    found = registry.kind(kind)
    for reference in (found.orchestration, *found.compute.values()):
        assert callable(registry.load_compute(reference)), reference
