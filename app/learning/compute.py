"""What the child processes of learning run: train one policy, distil one policy. The learners (torch) are loaded in the child alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.platform import files
from app.platform.jobs import JobError, Report, compute, write_atomically
from ml import progress
from ml.trajectories import ReplayBuffer, from_parquet

if TYPE_CHECKING:
    from ml.rl.actor_critic import DdpgConfig, TrainedPolicy
    from ml.rl.networks import MlpPolicy

POLICY, TRAINING = "policy.onnx", "training.pt"
_CURVE_POINTS = 200


def told(report: Report, x_end: float, prefix: str = "") -> progress.Report:
    """A job's report for the science: its fractions become progress, its numbers points of learning curves from 0 to `x_end`."""

    def tell(fraction: float, message: str = "", **numbers: float) -> None:
        report.progress(fraction, message or None)
        if numbers:
            report.point(round(fraction * x_end, 6), **{prefix + name: value for name, value in numbers.items()})

    return tell


def read_buffer(sha256: str) -> ReplayBuffer:
    """A stored snapshot's buffer."""
    return from_parquet(files.read(sha256))


@compute("train")
def train(params: dict[str, Any], workdir: Path, report: Report) -> dict[str, Any]:
    """Train one policy with DDPG on a snapshot, from scratch or from another policy.

    Args:
        params: `snapshot_sha256`; `config`, members of `DdpgConfig`; optionally `initial` with `checkpoint_sha256` or `onnx_sha256`.
        workdir: gets the policy as `policy.onnx` and the whole training as `training.pt`.
        report: learning curves over updates.
    """
    from ml.rl import actor_critic
    from ml.rl.training import CheckpointError, TrainingDiverged

    buffer = read_buffer(params["snapshot_sha256"])
    try:
        initial = _initial(params.get("initial"))
        config = _config(params["config"], initial)
        result = actor_critic.train(buffer, config, told(report, config.updates), workdir / "checkpoint.pt", initial)
    except (TrainingDiverged, CheckpointError, ValueError) as error:
        raise JobError(f"The policy cannot be trained: {error}.") from error
    write_atomically(workdir / POLICY, result.policy.to_onnx())
    write_atomically(workdir / TRAINING, result.to_bytes())
    states = buffer.transitions().states
    actions = result.policy.act(states)
    last = {name: float(values[-1]) for name, values in result.curve.items()}
    return {
        "config": config.to_json(),
        "metrics": {
            "curve": {name: _thinned(values.tolist()) for name, values in result.curve.items()},
            "last": last,
            "mean_amplitude_on_buffer": float(actions.mean()),
            "parameters": result.policy.parameter_count,
            "macs": result.policy.macs,
        }
        | _scale_of(result.policy),
    }


@compute("distil")
def distil(params: dict[str, Any], workdir: Path, report: Report) -> dict[str, Any]:
    """Distil one policy into a small one.

    Args:
        params: `snapshot_sha256`; `teacher_sha256`, the teacher's ONNX file; `config`, members of `DistilConfig`.
        workdir: gets the student as `policy.onnx`.
        report: the loss over updates.
    """
    from ml.rl.distillation import DistilConfig, distil
    from ml.rl.onnx_policy import OnnxPolicy
    from ml.rl.training import TrainingDiverged

    buffer = read_buffer(params["snapshot_sha256"])
    given = params["config"]
    try:
        config = DistilConfig(**(given | ({"hidden": tuple(given["hidden"])} if "hidden" in given else {})))
        teacher = OnnxPolicy(files.read(params["teacher_sha256"]), buffer.settings.window)
        result = distil(teacher, buffer, config, told(report, config.updates))
    except (TrainingDiverged, ValueError) as error:
        raise JobError(f"The policy cannot be distilled: {error}.") from error
    write_atomically(workdir / POLICY, result.policy.to_onnx())
    states = buffer.transitions().states
    return {
        "config": config.to_json(),
        "metrics": result.report()
        | {
            "curve": {name: _thinned(values.tolist()) for name, values in result.curve.items()},
            "mean_amplitude_on_buffer": float(result.policy.act(states).mean()),
        }
        | _scale_of(result.policy),
    }


def _initial(start: dict[str, str] | None) -> TrainedPolicy | MlpPolicy | None:
    from ml.rl.actor_critic import TrainedPolicy
    from ml.rl.networks import MlpPolicy

    if start is None:
        return None
    if "checkpoint_sha256" in start:
        return TrainedPolicy.from_bytes(files.read(start["checkpoint_sha256"]))
    return MlpPolicy.from_onnx(files.read(start["onnx_sha256"]))


def _config(values: dict[str, Any], initial: TrainedPolicy | MlpPolicy | None) -> DdpgConfig:
    """The hyper-parameters; a fine-tuned policy keeps the layers of its start, and without its critic learns that one first."""
    from ml.rl.actor_critic import DdpgConfig, TrainedPolicy

    if isinstance(initial, TrainedPolicy):
        values = values | {"hidden": list(initial.config.hidden)}
    elif initial is not None:
        values = values | {"hidden": list(initial.hidden), "critic_warmup": values["updates"] // 4}
    return DdpgConfig.from_json(values)


def _scale_of(policy: MlpPolicy) -> dict[str, float]:
    return {"beta_mean": float(policy.mean), "beta_std": float(policy.std)}


def _thinned(values: list[float]) -> list[float]:
    """At most `_CURVE_POINTS` of a curve's points, the last one among them."""
    step = -(-len(values) // _CURVE_POINTS)
    return values[::-1][::step][::-1]
