"""Random files of every lab format, written by another library or by the specification: nothing wrong, and nearly all of it used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ml.formats import DecodeOptions, decode, redact, sniff
from tests.ml.formats.peers.check import compare
from tests.ml.formats.peers.files import WRITERS


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("kind", sorted(WRITERS))
def test_every_sample_is_at_its_time_and_every_amplitude_right_or_unknown(kind: str, seed: int, tmp_path: Path) -> None:
    written = WRITERS[kind](tmp_path / "file", np.random.default_rng([seed, 37]))
    assert sniff(tmp_path / "file") == kind
    redact(tmp_path / "file", tmp_path / "clean", kind, bytes(32))
    assert sniff(tmp_path / "clean") == kind
    found = decode(tmp_path / "clean", kind, DecodeOptions(keep_samples=True))
    outcome = compare(found.recordings, written.truth, written.names, written.lsb_uv, pause=written.pause, steps=written.steps)
    assert (outcome.wrong_samples, outcome.wrong_steps) == (0, 0)
    assert outcome.found_samples >= 0.97 * outcome.samples
    assert outcome.known_steps >= 0.95 * outcome.steps
    assert {r.kind for r in found.recordings} == {kind}


@pytest.mark.parametrize("kind", sorted(WRITERS))
def test_a_file_cleaned_twice_is_the_same_and_so_is_one_of_the_same_bytes(kind: str, tmp_path: Path) -> None:
    WRITERS[kind](tmp_path / "file", np.random.default_rng(5))
    for source, target in (("file", "one"), ("file", "two"), ("one", "three")):
        redact(tmp_path / source, tmp_path / target, kind, bytes(32))
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    assert decode(tmp_path / "one", kind).recordings[0].fingerprint == decode(tmp_path / "three", kind).recordings[0].fingerprint
