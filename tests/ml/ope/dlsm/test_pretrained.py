"""The constants that members start from: of one format, small, rebuilt by one command, refused where they do not fit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ml.ope.dlsm import pretrained
from ml.ope.dlsm.batches import make_batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.networks import DlsmNetworks
from ml.ope.dlsm.training import MemberTraining
from ml.ope.scale import learn_scale
from ml.trajectories import ReplayBuffer

ROOT = Path(__file__).resolve().parents[4]
EXPERT = DlsmConfig.expert("demo")


def with_about(path: Path, **changes: Any) -> Path:
    """A copy of the package's file with something else said about it."""
    with np.load(pretrained.PATH) as stored:
        about = json.loads(str(stored["about"])) | changes
        np.savez(path, **{name: stored[name] for name in stored.files} | {"about": np.array(json.dumps(about))})
    return path


def test_the_file_of_the_package_is_small_and_fits_the_form_of_a_jobs_dlsm() -> None:
    assert pretrained.PATH.stat().st_size < 1_000_000
    networks = DlsmNetworks(10, EXPERT)
    before = networks.decoder.w_h.detach().clone()
    assert pretrained.start(networks)
    assert not torch.equal(before, networks.decoder.w_h)
    with np.load(pretrained.PATH) as stored:
        torch.testing.assert_close(networks.decoder.w_h.detach(), torch.from_numpy(stored["decoder.w_h"]))
        assert "part A" in json.loads(str(stored["about"]))["made_from"]


def test_a_file_of_another_format_or_shape_and_a_missing_one_are_refused_and_say_how_to_mend_it(tmp_path: Path) -> None:
    networks = DlsmNetworks(10, EXPERT)
    other = with_about(tmp_path / "pretrained.npz", format=pretrained.FORMAT + 1)
    with pytest.raises(ValueError, match=r"has format 2, and this betaloop reads format 1: make it anew with `python -m"):
        pretrained.start(networks, other)
    with pytest.raises(ValueError, match=r"of a DLSM with hidden 24 and not 12: set pretrained=False"):
        pretrained.start(DlsmNetworks(10, replace(EXPERT, hidden=12)))
    with pytest.raises(ValueError, match="are missing: make it anew"):
        pretrained.start(networks, tmp_path / "none.npz")


def test_states_of_another_window_start_anew() -> None:
    networks = DlsmNetworks(5, EXPERT)
    before = {k: v.clone() for k, v in networks.state_dict().items()}
    assert not pretrained.start(networks)
    assert all(torch.equal(v, before[k]) for k, v in networks.state_dict().items())


@pytest.mark.parametrize("started", [True, False])
def test_a_member_starts_from_the_file_and_says_so(small_buffer: ReplayBuffer, started: bool) -> None:
    scale = learn_scale(small_buffer)
    config = replace(EXPERT, pretrained=started, steps=1, check_every=1, replay_draws=2)
    training = MemberTraining(small_buffer, make_batch(small_buffer, scale), scale, [0, 5], config, 7, "")
    with np.load(pretrained.PATH) as stored:
        assert torch.equal(training.networks.encoder.w_x.detach(), torch.from_numpy(stored["encoder.w_x"])) == started
    assert training.run().pretrained == started


@pytest.mark.slow
def test_one_command_makes_a_file_that_members_can_start_from(tmp_path: Path) -> None:
    path = tmp_path / "made.npz"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    called = [sys.executable, "-m", "benchmarks.development.dlsm_pretraining", "--quick", "--out", str(path)]
    done = subprocess.run(called, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["figures"]["bytes"] == path.stat().st_size
    assert pretrained.start(DlsmNetworks(10, EXPERT), path)
