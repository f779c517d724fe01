"""Copies that run here: a shared library of our own header, and TFLite files with `betaloop[ports]`."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from ml.deploy.bundle import HEADER, HEADER_INT8, unpack
from ml.deploy.ports.answers import write_answers
from ml.deploy.ports.check import check_port
from ml.deploy.ports.targets import TargetError, run_target
from tests.ml.deploy.ports.conftest import Ported


@pytest.mark.parametrize(("header", "least_ma"), [(HEADER, 0.0), (HEADER_INT8, 0.03)])
def test_our_header_as_a_shared_library_is_the_policy(port: Ported, tmp_path: Path, header: str, least_ma: float) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    (tmp_path / header).write_bytes(unpack(port.content)[header])
    options = ["-std=c99", "-O2", "-shared", "-fPIC", "-Dbetaloop_linkage=", "-x", "c"]
    subprocess.run([compiler, *options, header, "-o", "port.so"], cwd=tmp_path, check=True)
    answers = run_target(tmp_path / "port.so", port.vectors, port.opened.manifest)
    found = check_port(port.content, port.opened, write_answers(port.vectors, answers))
    assert (found.faults, found.compared) == ((), ("network", "decision"))
    assert found.worst_ma is not None
    assert found.worst_ma <= max(least_ma, 3e-5)


@pytest.mark.parametrize("content", [b"", b"no TFLite file", b"\x1c\0\0\0TFL3" + bytes(64)])
def test_a_file_that_the_interpreter_refuses_is_named(port: Ported, tmp_path: Path, content: bytes) -> None:
    pytest.importorskip("ai_edge_litert")
    (tmp_path / "copy.tflite").write_bytes(content)
    with pytest.raises(TargetError, match=r"the interpreter cannot run copy\.tflite") as caught:
        run_target(tmp_path / "copy.tflite", port.vectors, port.opened.manifest)
    assert "Convert it again" in caught.value.hint


def test_a_file_that_is_not_there_is_named(port: Ported, tmp_path: Path) -> None:
    with pytest.raises(TargetError, match=r"none\.onnx cannot be opened"):
        run_target(tmp_path / "none.onnx", port.vectors, port.opened.manifest)


def test_an_onnx_file_of_the_policy_gives_its_answers(port: Ported, tmp_path: Path) -> None:
    (tmp_path / "copy.onnx").write_bytes(unpack(port.content)["model.onnx"])
    answers = run_target(tmp_path / "copy.onnx", port.vectors, port.opened.manifest).fraction
    assert answers is not None
    np.testing.assert_allclose(answers[~port.vectors.without_dose], port.answers()[~port.vectors.without_dose], atol=1e-5)
