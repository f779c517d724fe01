from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ml.rl.algorithms.ddpg import DdpgConfig, train
from ml.rl.algorithms.registry import ALGORITHMS
from ml.rl.training import CheckpointError
from ml.trajectories import to_parquet

SMALL = DdpgConfig(hidden=(16, 12), updates=300, batch=16, record_every=10, checkpoint_every=7, actor_lr=1e-3, critic_weight_decay=1e-3)


def assert_same(one, two):
    assert one.policy.to_onnx() == two.policy.to_onnx()
    for name in one.networks:
        for left, right in zip(one.networks[name].parameters(), two.networks[name].parameters(), strict=True):
            np.testing.assert_array_equal(left.detach().numpy(), right.detach().numpy())
    for name in one.curve:
        np.testing.assert_array_equal(one.curve[name], two.curve[name])


def test_how_often_it_is_saved_changes_nothing(buffer, tmp_path):
    often = DdpgConfig.from_json(SMALL.to_json() | {"checkpoint_every": 1})
    assert train(buffer, often, checkpoint=tmp_path / "often.ckpt").policy.to_onnx() == train(buffer, SMALL).policy.to_onnx()


def test_the_checkpoint_of_another_run_is_refused(buffer, make_buffer, tmp_path):
    file = tmp_path / "training.ckpt"
    first = train(buffer, SMALL, checkpoint=file)
    with pytest.raises(CheckpointError, match="another configuration"):
        train(buffer, DdpgConfig.from_json(SMALL.to_json() | {"tau": 0.5}), checkpoint=file)
    with pytest.raises(CheckpointError, match="other data"):
        train(make_buffer(buffer.settings, seed=1), SMALL, checkpoint=file)
    with pytest.raises(CheckpointError, match="another start"):
        train(buffer, SMALL, checkpoint=file, initial=first)


@pytest.mark.parametrize("damage", [b"", b"half a file", None])
def test_a_damaged_checkpoint_is_refused_and_says_how_to_mend_it(buffer, tmp_path, damage):
    file = tmp_path / "training.ckpt"
    train(buffer, SMALL, checkpoint=file)
    file.write_bytes(file.read_bytes()[:-200] if damage is None else damage)
    with pytest.raises(CheckpointError, match=r"training\.ckpt cannot be read; delete it"):
        train(buffer, SMALL, checkpoint=file)


WORKER = """
import sys
from pathlib import Path
from ml.rl.algorithms import algorithm
from ml.trajectories import from_parquet

def report(fraction, message="", **numbers):
    sys.stdout.write(message + chr(10))
    sys.stdout.flush()

folder, kind = Path(sys.argv[1]), algorithm(sys.argv[2])
buffer = from_parquet((folder / "buffer.parquet").read_bytes())
kind.train(buffer, kind.config.from_json(eval(sys.argv[3])), report, folder / "training.ckpt")
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_a_training_killed_by_the_system_resumes_to_the_same_weights(name, buffer, tmp_path):
    kind = ALGORITHMS[name]
    config = kind.config(hidden=(32, 24), updates=1500, batch=32, record_every=50, checkpoint_every=130)
    (tmp_path / "buffer.parquet").write_bytes(to_parquet(buffer))
    root = Path(__file__).parents[3]
    for kill_after in (400, 900):
        worker = subprocess.Popen(
            [sys.executable, "-c", WORKER, str(tmp_path), name, repr(config.to_json())],
            stdout=subprocess.PIPE,
            text=True,
            cwd=root,
            env=os.environ | {"PYTHONPATH": str(root)},
        )
        assert worker.stdout is not None
        for line in worker.stdout:
            if int(line.split()[1]) >= kill_after:
                worker.send_signal(signal.SIGKILL)
                break
        worker.stdout.close()
        assert worker.wait() == -signal.SIGKILL
    updates = []
    file = tmp_path / "training.ckpt"
    resumed = kind.train(buffer, config, lambda f, message="", **n: updates.append(int(message.split()[1])), file)
    assert updates[0] > 700, "it must go on from the checkpoint, not start again"
    assert_same(resumed, kind.train(buffer, config))
