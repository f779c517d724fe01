"""`betaloop control check-port`: exit codes, JSON, the page, and errors that name line and remedy."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from pypdf import PdfReader
from typer.testing import CliRunner

from app.cli import app
from app.platform.errors import Invalid
from app.tablet.ports import Outputs, check
from ml.deploy.bundle import build_bundle, open_bundle, sign, unpack
from ml.deploy.manifest import BundleManifest
from ml.deploy.ports.answers import Answers, write_answers
from ml.deploy.ports.check import port_vectors
from ml.deploy.ports.vectors import PortVectors
from ml.rl import MlpPolicy

MANIFEST = BundleManifest(
    participant="P1", policy_id=3, policy_name="rl-03", window=10, beta_unit="uV", beta_source="table", min_ma=0.5, max_ma=3.0, cdbs_ma=3.0,
    ramp_ma_per_s=0.25, frozen_after=5, code_version="0.1.0",
)  # fmt: skip


@pytest.fixture
def world(tmp_path: Path) -> tuple[Path, str, PortVectors]:
    """A signed bundle, the key that it is signed with, and its vectors."""
    key = Ed25519PrivateKey.generate()
    windows = np.abs(np.random.default_rng(0).normal(30.0, 9.0, (40, 10)))
    content = sign(build_bundle(MlpPolicy(10, (20, 10), mean=30.0, std=9.0, seed=3).to_onnx(), MANIFEST, windows), key)
    (tmp_path / "bundle.zip").write_bytes(content)
    return tmp_path / "bundle.zip", key.public_key().public_bytes_raw().hex(), port_vectors(content, open_bundle(content).manifest)


def run(*arguments: Any) -> Any:
    return CliRunner().invoke(app, ["control", "check-port", *map(str, arguments)])


def test_a_table_of_the_right_answers_is_the_same_and_exits_with_0(world: tuple[Path, str, PortVectors], tmp_path: Path) -> None:
    bundle, key, vectors = world
    (tmp_path / "answers.csv").write_bytes(write_answers(vectors, Answers(vectors.dose, None)))
    done = run(tmp_path / "answers.csv", "--bundle", bundle, "--key", key, "--json", "--page", tmp_path / "page.html", "--target", "TFLite")
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert (found["verdict"], found["headline"], found["faults"]) == ("same", "TFLite: same", [])
    assert "TFLite" in (tmp_path / "page.html").read_text()


def test_a_faulty_copy_is_named_and_exits_with_1(world: tuple[Path, str, PortVectors], tmp_path: Path) -> None:
    bundle, key, vectors = world
    (tmp_path / "answers.csv").write_bytes(write_answers(vectors, Answers(np.nan_to_num(vectors.dose, nan=0.25), None)))
    done = run(tmp_path / "answers.csv", "--bundle", bundle, "--key", key)
    assert done.exit_code == 1
    assert "a lost sample gets 0.75 mA" in done.stdout
    assert "not this policy" in done.stdout


def test_an_onnx_file_runs_here_and_its_answers_can_be_taken_along(world: tuple[Path, str, PortVectors], tmp_path: Path) -> None:
    bundle, key, _ = world
    (tmp_path / "copy.onnx").write_bytes(unpack(bundle.read_bytes())["model.onnx"])
    done = run(tmp_path / "copy.onnx", "--bundle", bundle, "--key", key, "--answers", tmp_path / "answers.csv")
    assert (done.exit_code, done.stdout.splitlines()[0]) == (0, "copy.onnx, port of policy rl-03 of P1: same")
    assert run(tmp_path / "answers.csv", "--bundle", bundle, "--key", key).exit_code == 0
    with pytest.raises(Invalid, match="cannot be written: File exists"):
        check(tmp_path / "copy.onnx", bundle, key, Outputs(answers=tmp_path / "answers.csv"))


def test_the_page_as_pdf_is_one_page_with_verdict_and_hashes(world: tuple[Path, str, PortVectors], tmp_path: Path) -> None:
    bundle, key, vectors = world
    (tmp_path / "answers.csv").write_bytes(write_answers(vectors, Answers(np.nan_to_num(vectors.dose, nan=0.25), None)))
    run(tmp_path / "answers.csv", "--bundle", bundle, "--key", key, "--page", tmp_path / "page.pdf", "--target", "TFLite µ → int8")
    (printed,) = PdfReader(tmp_path / "page.pdf").pages
    text = " ".join(printed.extract_text().split())
    assert "Not this policy: not to be connected. A lost sample gets 0.75 mA." in text
    assert hashlib.sha256((tmp_path / "answers.csv").read_bytes()).hexdigest() in text
    assert "Clinician, date: seen" in text


def test_an_unusable_table_names_file_line_and_remedy(world: tuple[Path, str, PortVectors], tmp_path: Path) -> None:
    bundle, key, vectors = world
    lines = write_answers(vectors, Answers(vectors.dose, None)).decode().splitlines()
    (tmp_path / "cut.csv").write_text("\n".join(lines[:200]))
    with pytest.raises(Invalid) as caught:
        check(tmp_path / "cut.csv", bundle, key, Outputs())
    assert caught.value.detail == "cut.csv, line 200: the file ends here, after 199 of 400 rows."
    assert "Write every row" in str(caught.value.hint)
    with pytest.raises(Invalid, match=r"none\.csv cannot be read"):
        check(tmp_path / "none.csv", bundle, key, Outputs())


def test_a_bundle_of_another_key_is_refused_before_anything_runs(world: tuple[Path, str, PortVectors], tmp_path: Path) -> None:
    with pytest.raises(Invalid, match="must not be used"):
        check(tmp_path / "copy.so", world[0], "ab" * 32, Outputs())


def test_control_without_a_bundle_says_so() -> None:
    done = CliRunner().invoke(app, ["control"])
    assert done.exit_code == 2
    assert "bundle" in done.output
