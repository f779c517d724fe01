"""What the child processes of learning run: training, scores of what learns nothing, distillation. Only they load the learners."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.platform import files
from app.platform.jobs import JobError, Report, compute, write_atomically
from ml import progress
from ml.trajectories import ReplayBuffer, from_parquet

if TYPE_CHECKING:
    from ml.policies.policy import Policy
    from ml.rl.configs import TrainConfig
    from ml.rl.held_out import HeldOut
    from ml.rl.networks import MlpPolicy
    from ml.rl.trainer import TrainedPolicy

POLICY, CLONE = "policy.onnx", "clone.onnx"
FEWEST_TO_HOLD_OUT = 5
"""Sessions below which none is held out of a training."""

CONSTANT_GRID = tuple(round(0.05 * k, 2) for k in range(21))
CLONE_UPDATES = 2000
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
    """Train the policies of one group side by side on a snapshot, from scratch or from another policy.

    Args:
        params: `snapshot_sha256`; `algorithm`; `configs`, members of its configuration; `held_out`, whether sessions are left out;
            optionally `initial` with `checkpoint_sha256` or `onnx_sha256`.
        workdir: gets each policy as `policy-K.onnx` and its whole training as `training-K.pt`.
        report: learning curves over updates.

    Returns:
        `members` with `config` and `metrics` each; `held_out_sessions`.
    """
    from ml.rl.algorithms.registry import algorithm
    from ml.rl.training import CheckpointError, TrainingDiverged

    buffer = read_buffer(params["snapshot_sha256"])
    try:
        method = algorithm(params["algorithm"])
        initial = _initial(params.get("initial"))
        configs = [method.config.from_json(_with_start(given, initial)) for given in params["configs"]]
        updates = configs[0].updates
        learnt, held_out = _hold_out(buffer, params["held_out"], every=max(1, updates // 10))
        told_to = told(report, updates)
        results = method.train_many(learnt, configs, told_to, workdir / "checkpoint.pt", initial, held_out)
    except (TrainingDiverged, CheckpointError, ValueError) as error:
        raise JobError(f"The policies cannot be trained: {error}.") from error
    gains = gains_over_cdbs(buffer, [result.policy for result in results])
    members = []
    for k, (result, gain) in enumerate(zip(results, gains, strict=True)):
        write_atomically(workdir / policy_file(k), result.policy.to_onnx())
        write_atomically(workdir / training_file(k), result.to_bytes())
        metrics = _metrics(result, buffer) | _share_of_end(learnt, result.config) | {"gain_over_cdbs": gain}
        members.append({"config": result.config.to_json(), "metrics": metrics})
    return {"members": members, "held_out_sessions": [s.session_id for s in held_out.sessions.sessions] if held_out else []}


def policy_file(member: int) -> str:
    """Name of a trained policy's file in the folder of its step."""
    return f"policy-{member}.onnx"


def training_file(member: int) -> str:
    """Name of a whole training's file in the folder of its step."""
    return f"training-{member}.pt"


@compute("yardsticks")
def yardsticks(params: dict[str, Any], workdir: Path, report: Report) -> dict[str, Any]:
    """Score controllers that learn nothing, or no more than to imitate, as the policies of the sweep are scored.

    Args:
        params: `snapshot_sha256`; `held_out`, whether sessions are left out; `seed`.
        workdir: gets the clone of the logged behaviour as `clone.onnx`.
        report: progress.

    Returns:
        `rows` with `controller`, `score` and `mean_amplitude`; `best_constant`, the amplitude that scores best; `held_out_sessions`.
    """
    from ml.ope.fqe.score import fqe_value
    from ml.policies.policy import ConstantPolicy
    from ml.rl.algorithms.registry import algorithm
    from ml.rl.baselines import behaviour_mean, proportional_from_buffer
    from ml.rl.training import TrainingDiverged

    buffer = read_buffer(params["snapshot_sha256"])
    learnt, held_out = _hold_out(buffer, params["held_out"], every=1)
    watched = held_out.sessions.sessions if held_out else ()
    cloning = algorithm("cloning")
    try:
        clone = cloning.train(learnt, cloning.config.from_json({"updates": CLONE_UPDATES, "seed": params["seed"]})).policy
    except (TrainingDiverged, ValueError) as error:
        raise JobError(f"The logged behaviour cannot be cloned: {error}.") from error
    write_atomically(workdir / CLONE, clone.to_onnx())
    report.progress(0.3, "scoring constant amplitudes")
    scores = {a: fqe_value(learnt, ConstantPolicy(a), watched).value for a in CONSTANT_GRID}
    best = max(scores, key=lambda a: scores[a])
    named: dict[str, Policy] = {
        "cDBS": ConstantPolicy(1.0),
        f"best constant, {best:.2f}": ConstantPolicy(best),
        "mean logged amplitude, held": behaviour_mean(learnt),
        "behaviour clone": clone,
        "no DBS": ConstantPolicy(0.0),
    }
    with contextlib.suppress(ValueError):  # beta without spread has no proportional control
        named["proportional to beta"] = proportional_from_buffer(learnt)
    states = buffer.transitions().states
    rows = [
        {"controller": name, "score": fqe_value(learnt, p, watched).value, "mean_amplitude": float(p.act(states).mean())}
        for name, p in named.items()
    ]
    return {"rows": rows, "best_constant": best, "held_out_sessions": [s.session_id for s in watched]}


def _hold_out(buffer: ReplayBuffer, wanted: bool, every: int) -> tuple[ReplayBuffer, HeldOut | None]:
    """Sessions to learn from, and those that watch; all and none where they are too few to spare any."""
    from ml.ope.fqe.score import fqe_value
    from ml.rl.held_out import HeldOut, split_sessions
    from ml.rl.support import stays_in_range

    if not wanted or len(buffer.sessions) < FEWEST_TO_HOLD_OUT:
        return buffer, None
    learnt, left = split_sessions(buffer)
    # a split may leave nothing to start a score from; then nobody watches
    if not any(s.usable().any() for s in left.sessions) or not learnt.transitions().states.size:
        return buffer, None
    watching = HeldOut(
        sessions=left,
        score=lambda policy: fqe_value(learnt, policy, left.sessions).value,
        score_name="fqe",
        eligible=lambda policy: stays_in_range(policy, learnt),
        every=every,
        patience=6,
    )
    return learnt, watching


def _share_of_end(learnt: ReplayBuffer, config: TrainConfig) -> dict[str, Any]:
    """How well r_end falls apart into shares of steps, where a policy was to learn from them; null where it learned without."""
    from ml.rl.end_reward import fit_end_reward

    if config.aim != "return":
        return {}
    share = fit_end_reward(learnt)
    return {"end_reward": {"skill": share.skill, "sessions": share.sessions} if share else None}


def gains_over_cdbs(buffer: ReplayBuffer, policies: Sequence[Policy]) -> list[dict[str, float] | None]:
    """Gain of each policy over cDBS by fitted Q evaluation of the whole buffer, with its lower bound over resampled sessions.

    The policies have seen most of these sessions, which flatters them; the resamples are the same for all. None where the sessions allow
    no such estimate.
    """
    from ml.ope.fqe.estimator import Fqe
    from ml.policies.policy import ConstantPolicy
    from ml.rl.selection import gains_over

    named = {str(k): policy for k, policy in enumerate(policies)}
    try:
        gains = gains_over(Fqe().fit(buffer), named, ConstantPolicy(1.0))
    except ValueError:  # what the method says of sessions that it cannot start from
        return [None] * len(policies)
    return [asdict(gains[name]) for name in named]


def _below_bound(policy: Policy, buffer: ReplayBuffer) -> dict[str, Any]:
    """How often a policy asks for less, on the buffer's states, than the random controller was allowed to; null without such a session."""
    from ml.rl.support import random_bound, share_below_bound

    bound = random_bound(buffer)
    return {"below_bound": None if bound is None else {"bound": bound, "share": share_below_bound(policy, buffer)}}


def _metrics(result: TrainedPolicy, buffer: ReplayBuffer) -> dict[str, Any]:
    """What a trained policy is stored with."""
    from ml.rl.algorithms.learners import SATURATION_MARGIN

    held = {name: values.tolist() for name, values in result.held_out.items()}
    steps = buffer.transitions()
    actions = result.policy.act(steps.states)
    return {
        "curve": {name: _thinned(values.tolist()) for name, values in result.curve.items()},
        "last": {name: float(values[-1]) for name, values in result.curve.items()},
        "held_out": held,
        "best_update": result.best_update,
        "mean_amplitude_on_buffer": float(actions.mean()),
        "kept": {
            "action_distance": float(abs(actions - steps.actions).mean()),
            "saturated": float((abs(actions - 0.5) > 0.5 - SATURATION_MARGIN).mean()),
        },
        "parameters": result.policy.parameter_count,
        "macs": result.policy.macs,
    } | (_below_bound(result.policy, buffer) | _scale_of(result.policy))


@compute("distil")
def distil(params: dict[str, Any], workdir: Path, report: Report) -> dict[str, Any]:
    """Distil one policy into a small one.

    Args:
        params: `snapshot_sha256`; `teacher_sha256`, the teacher's ONNX file; `config`, members of `DistilConfig`.
        workdir: gets the student as `policy.onnx`.
        report: the loss over updates.
    """
    from ml.policies.onnx_policy import OnnxPolicy
    from ml.rl.distillation import DistilConfig, distil
    from ml.rl.training import TrainingDiverged

    buffer = read_buffer(params["snapshot_sha256"])
    given = params["config"]
    try:
        config = DistilConfig(**(given | ({"hidden": tuple(given["hidden"])} if "hidden" in given else {})))
        teacher = OnnxPolicy(files.read(params["teacher_sha256"]), buffer.settings.window)
        result = distil(teacher, buffer, config, told(report, config.updates), partial(_returns_beside, buffer))
    except (TrainingDiverged, ValueError) as error:
        raise JobError(f"The policy cannot be distilled: {error}.") from error
    write_atomically(workdir / POLICY, result.policy.to_onnx())
    return {
        "config": config.to_json(),
        "metrics": result.report()
        | {
            "curve": {name: _thinned(values.tolist()) for name, values in result.curve.items()},
            "mean_amplitude_on_buffer": float(result.policy.act(buffer.transitions().states).mean()),
        }
        | _below_bound(result.policy, buffer)
        | _scale_of(result.policy),
    }


def _returns_beside(buffer: ReplayBuffer, student: Policy, teacher: Policy) -> dict[str, float]:
    """Estimated returns of student and teacher by one fitted Q evaluation of the whole buffer, reward units."""
    from ml.ope.fqe.score import fqe_value

    return {
        "student_return": fqe_value(buffer, student, ()).value,
        "teacher_return": fqe_value(buffer, teacher, ()).value,
    }


def _initial(start: dict[str, str] | None) -> TrainedPolicy | MlpPolicy | None:
    from ml.rl.networks import MlpPolicy
    from ml.rl.trainer import TrainedPolicy

    if start is None:
        return None
    if "checkpoint_sha256" in start:
        return TrainedPolicy.from_bytes(files.read(start["checkpoint_sha256"]))
    return MlpPolicy.from_onnx(files.read(start["onnx_sha256"]))


def _with_start(values: dict[str, Any], initial: TrainedPolicy | MlpPolicy | None) -> dict[str, Any]:
    """Hyper-parameters for a start: a fine-tuned policy keeps its layers, and without its critic learns that one first."""
    if initial is None:
        return values
    from ml.rl.trainer import TrainedPolicy

    if isinstance(initial, TrainedPolicy):
        return values | {"hidden": list(initial.config.hidden)}
    warmup = {"critic_warmup": values["updates"] // 4} if "critic_lr" in values else {}
    return values | {"hidden": list(initial.hidden)} | warmup


def _scale_of(policy: MlpPolicy) -> dict[str, float]:
    return {"beta_mean": float(policy.mean), "beta_std": float(policy.std)}


def _thinned(values: list[float]) -> list[float]:
    """At most `_CURVE_POINTS` of a curve's points, the last one among them."""
    step = -(-len(values) // _CURVE_POINTS)
    return values[::-1][::step][::-1]
