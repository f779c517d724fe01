"""The disk cache of compiled functions: two processes at once, and folders that cannot be written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
KERNEL = """
from ml.compiled import compiled

@compiled()
def half(x):
    return x / 2
"""
# both processes read the empty index before either writes; the second overwrites the index and only then does the first write its code
SLOWLY = """
import sys, time
from numba.core.caching import IndexDataCacheFile as File
before_index, before_code = float(sys.argv[2]), float(sys.argv[3])
save_index, save_data = File._save_index, File._save_data
def slow_index(self, overloads): time.sleep(before_index); save_index(self, overloads)
def slow_data(self, name, data): time.sleep(before_code); save_data(self, name, data)
File._save_index, File._save_data = slow_index, slow_data
"""
CALL = "import sys; from kernel import half; print(half({'int': 7, 'float': 7.0}[sys.argv[1]]), len(half.stats.cache_hits))"


def call(folder: Path, code: str, *arguments: str, **env: str) -> subprocess.Popen[str]:
    path = {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}", "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments], env=os.environ | path | env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def said(process: subprocess.Popen[str]) -> str:
    out, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    return out.strip()


@pytest.mark.slow
def test_two_processes_that_compile_at_once_do_not_mix_their_code(tmp_path: Path) -> None:
    (tmp_path / "kernel.py").write_text(KERNEL)
    first = call(tmp_path, SLOWLY + CALL, "int", "2.0", "3.0")
    second = call(tmp_path, SLOWLY + CALL, "float", "3.0", "0.0")
    assert said(first) == "3.5 0"
    assert said(second) == "3.5 0"
    for kind in ("int", "float"):
        assert said(call(tmp_path, CALL, kind)) == "3.5 1", f"the code of {kind} was not found, or is that of the other type"


def test_without_a_folder_to_write_everything_is_compiled_anew(tmp_path: Path) -> None:
    (tmp_path / "kernel.py").write_text(KERNEL)
    # a file where the folder should be: no user, not even root, can write under it
    (tmp_path / "__pycache__").write_text("")
    home = tmp_path / "home"
    home.write_text("")
    for _ in range(2):
        assert said(call(tmp_path, CALL, "int", HOME=str(home), XDG_CACHE_HOME=str(home))) == "3.5 0"


@pytest.mark.parametrize(
    "name", ["ml.population.physiology.brain", "ml.population.physiology.symptoms", "ml.ope.dlsm.heads", "ml.ope.dlsm.kernels"]
)
def test_no_kernel_goes_round_the_shared_cache(name: str) -> None:
    source = (ROOT / (name.replace(".", "/") + ".py")).read_text()
    assert "@compiled(" in source
    assert "njit" not in source
