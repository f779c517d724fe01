"""Bytecode next to the modules that processes import: packages are not compiled at each start."""

from __future__ import annotations

import ast
import os
import subprocess
import sys

WITHOUT = """
import sys
from importlib.util import cache_from_source
from pathlib import Path
import app.main, app.platform.jobs.worker, app.learning.training_compute as training
app.main.create_app()
training.prepare()
files = [f for m in list(sys.modules.values()) if (f := getattr(m, "__file__", None)) and f.endswith(".py") and "site-packages" in f]
print((len(files), [f for f in files if not Path(cache_from_source(f)).exists()]))
"""


def test_no_module_of_the_packages_is_compiled_again_at_each_start() -> None:
    env = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    said = subprocess.run([sys.executable, "-c", WITHOUT], check=True, capture_output=True, text=True, timeout=600, env=env).stdout
    looked_at, without = ast.literal_eval(said)
    assert looked_at > 1500
    assert without == [], "tests/packages/bytecode.py, which `make install` runs, does not load these"
