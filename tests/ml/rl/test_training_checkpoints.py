from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ml.rl.actor_critic import DdpgConfig, train
from ml.rl.training import CheckpointError
from ml.trajectories import to_parquet

SMALL = DdpgConfig(hidden=(16, 12), updates=300, batch=16, record_every=10, checkpoint_every=7, actor_lr=1e-3, critic_weight_decay=1e-3)


class StoppedHere(Exception):
    pass


def stop_at(update):
    def report(fraction, message="", **numbers):
        if round(fraction * SMALL.updates) >= update:
            raise StoppedHere

    return report


def assert_same(one, two):
    assert one.policy.to_onnx() == two.policy.to_onnx()
    for left, right in zip(one.critic.parameters(), two.critic.parameters(), strict=True):
        np.testing.assert_array_equal(left.detach().numpy(), right.detach().numpy())
    assert one.curve.keys() == two.curve.keys()
    for name in one.curve:
        np.testing.assert_array_equal(one.curve[name], two.curve[name])


@pytest.mark.parametrize("stops", [(10,), (260,), (40, 150, 290)])
def test_a_training_that_was_interrupted_ends_with_the_weights_of_one_that_was_not(buffer, tmp_path, stops):
    whole = train(buffer, SMALL)
    file = tmp_path / "training.ckpt"
    for stop in stops:  # neither a multiple of the checkpoint's 7 updates nor of the 256 of a block of batches
        with pytest.raises(StoppedHere):
            train(buffer, SMALL, stop_at(stop), checkpoint=file)
    assert file.exists()
    seen = []
    resumed = train(buffer, SMALL, lambda fraction, message="", **numbers: seen.append(round(fraction * SMALL.updates)), checkpoint=file)
    assert seen[0] >= stops[-1], "it must go on from the checkpoint, not start again"
    assert_same(resumed, whole)


def test_a_finished_training_is_not_done_again(buffer, tmp_path):
    file = tmp_path / "training.ckpt"
    whole = train(buffer, SMALL, checkpoint=file)
    assert_same(train(buffer, SMALL, stop_at(0), checkpoint=file), whole)


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
from ml.rl.actor_critic import DdpgConfig, train
from ml.trajectories import from_parquet

def report(fraction, message="", **numbers):
    sys.stdout.write(message + chr(10))
    sys.stdout.flush()

folder = Path(sys.argv[1])
train(from_parquet((folder / "buffer.parquet").read_bytes()), DdpgConfig.from_json(eval(sys.argv[2])), report, folder / "training.ckpt")
"""


@pytest.mark.slow
def test_a_training_killed_by_the_system_resumes_to_the_same_weights(buffer, tmp_path):
    config = DdpgConfig(hidden=(64, 48), updates=3000, batch=64, record_every=50, checkpoint_every=130)
    (tmp_path / "buffer.parquet").write_bytes(to_parquet(buffer))
    root = Path(__file__).parents[3]
    for kill_after in (400, 1700):
        worker = subprocess.Popen(
            [sys.executable, "-c", WORKER, str(tmp_path), repr(config.to_json())],
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
    resumed = train(
        buffer, config, lambda f, message="", **n: updates.append(int(message.split()[1])), checkpoint=tmp_path / "training.ckpt"
    )
    assert updates[0] > 1500, "it must go on from the checkpoint, not start again"
    assert_same(resumed, train(buffer, config))
