"""Compute steps of learning, for child processes: training, scores of controllers without learning, distillation.

Loaded by those children alone: everything heavy is imported here, and nothing that the web service loads imports this module.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from app.learning.training_configs import BEST, CLONE, POLICY, policy_file, training_file
from app.learning.trajectories import read_buffer
from app.platform import files
from app.platform.jobs import JobError, StepReport, write_atomically
from ml import rl
from ml.faults import said_of
from ml.loading import load_libraries
from ml.ope import Levels, PosteriorGain, TestedDifference, Tests, gains_over_cdbs
from ml.ope.fqe.score import fqe_value
from ml.policies.from_buffer import behaviour_mean, proportional_from_buffer
from ml.policies.logged_range import random_bound, share_below_bound, stays_in_range
from ml.policies.onnx_policy import OnnxPolicy
from ml.policies.policy import ConstantPolicy, Policy
from ml.qoc import Margins
from ml.trajectories import ReplayBuffer

FEWEST_TO_HOLD_OUT = 5
"""Sessions below which none is held out of a training."""

CONSTANT_GRID = tuple(round(0.05 * k, 2) for k in range(4, 21))
"""Constant amplitudes that are asked for the best: twentieths from where stimulation is nearly off. Tenths lack the dose between one that
saves a fifth of the energy and one that keeps the margins."""

CLONE_UPDATES = 2000
_CURVE_POINTS = 200


def prepare() -> None:
    """Load what training uses, once, in the process whose forks train."""
    load_libraries()


def train(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Train the policies of one group side by side on a snapshot, from scratch or from another policy.

    Args:
        params: `snapshot_sha256`; `algorithm`; `configs`, members of its configuration; `held_out`, whether sessions are held out.
            `margins` as `_judged_by` takes them; `tested` as `known_tests` does. Optionally `initial` with `checkpoint_sha256` or
            `onnx_sha256`.
        workdir: gets each policy as `policy-K.onnx` and its whole training as `training-K.pt`.
        report: learning curves over updates.

    Returns:
        `members` with `config` and `metrics` each; `held_out_sessions`.
    """
    buffer = read_buffer(params["snapshot_sha256"])
    try:
        method = rl.algorithm(params["algorithm"])
        initial = _initial(params.get("initial"))
        tests = known_tests(params.get("tested"), buffer)
        given = with_best_anchor(params["configs"], buffer, params["margins"], tests)
        configs = [method.config.from_json(_with_start(one, initial)) for one in given]
        updates = configs[0].updates
        learnt, held_out = hold_out(buffer, params["held_out"], every=max(1, updates // 10))
        results = rl.train_many(learnt, configs, report.curves(updates), workdir / "checkpoint.pt", initial, held_out)
    except (rl.TrainingDiverged, rl.CheckpointError, ValueError) as error:
        raise JobError(f"The policies cannot be trained: {_why(error, report)}.") from error
    gains = stored_gains(buffer, {str(k): result.policy for k, result in enumerate(results)}, params["margins"], tests)
    members = []
    for k, result in enumerate(results):
        write_atomically(workdir / policy_file(k), result.policy.to_onnx())
        write_atomically(workdir / training_file(k), result.to_bytes())
        metrics = _metrics(result, buffer) | _share_of_end(learnt, result.config) | {"gain_over_cdbs": gains[str(k)]}
        members.append({"config": result.config.to_json(), "metrics": metrics})
    return {"members": members, "held_out_sessions": [s.session_id for s in held_out.sessions.sessions] if held_out else []}


def _why(error: Exception, report: StepReport) -> str:
    """Explain why a training ended, for people who read results; the network whose loss diverged goes to the log."""
    if not isinstance(error, rl.TrainingDiverged):
        return said_of(error, report.log)
    report.log(str(error))
    return "the training diverged; lower the learning rates"


def baselines(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Score controllers that learn nothing, or no more than to imitate, as the policies of the sweep are scored.

    Args:
        params: `snapshot_sha256`; `held_out`, whether sessions are held out; `margins` as `_judged_by` takes them; `tested` as
            `known_tests` does; `seed`.
        workdir: gets the clone of the logged behaviour as `clone.onnx`.
        report: progress.

    Returns:
        `rows` with `controller`, `score` on held-out sessions, `mean_amplitude` and `gain_over_cdbs`; `best_constant`, the amplitude with
        the largest expected saving (`best_supported`), None without one; `held_out_sessions`.
    """
    buffer = read_buffer(params["snapshot_sha256"])
    learnt, held_out = hold_out(buffer, params["held_out"], every=1)
    watched = held_out.sessions.sessions if held_out else ()
    cloning = rl.algorithm("cloning")
    try:
        clone = rl.train(learnt, cloning.config.from_json({"updates": CLONE_UPDATES, "seed": params["seed"]})).policy
    except (rl.TrainingDiverged, ValueError) as error:
        raise JobError(f"What the recorded sessions did cannot be imitated: {_why(error, report)}.") from error
    write_atomically(workdir / CLONE, clone.to_onnx())
    report.progress(0.3, "scoring constant amplitudes")
    tests = known_tests(params.get("tested"), buffer)
    best = supported_best(buffer, params["margins"], tests)
    named: dict[str, Policy] = {
        "cDBS": ConstantPolicy(1.0),
        **({} if best is None else {f"best constant, {best:.2f}": ConstantPolicy(best)}),
        "mean logged amplitude, held": behaviour_mean(learnt),
        "behaviour clone": clone,
        "no DBS": ConstantPolicy(0.0),
    }
    with contextlib.suppress(ValueError):  # beta without spread has no proportional control
        named["proportional to beta"] = proportional_from_buffer(learnt)
    states = buffer.transitions().states
    report.progress(0.6, "estimating gains over cDBS")
    gains = stored_gains(buffer, named, params["margins"], tests)
    rows = [
        {
            "controller": name,
            "score": fqe_value(learnt, p, watched).value,
            "mean_amplitude": float(p.act(states).mean()),
            "gain_over_cdbs": gains[name],
        }
        for name, p in named.items()
    ]
    return {"rows": rows, "best_constant": best, "held_out_sessions": [s.session_id for s in watched]}


PROBABLY = 0.5
"""Least probability of keeping the margins of an amplitude that policies are kept near."""


def best_supported(constants: Mapping[str, PosteriorGain], level: float) -> float | None:
    """Find the amplitude with the largest expected saving, by names such as `0.70`; None without one.

    The expected saving is the energy that it saves times the probability that all QoCs keep within the margins. Only amplitudes count that
    sessions support and that keep the margins with a probability of `level` at least. Where no QoC is known, the one with the largest gain
    counts: a saving alone would be the lowest of all.
    """
    fit = {name: one for name, one in constants.items() if one.supported and (one.within is None or one.within >= level)}
    known = {name: one.within * (1 - float(name) ** 2) for name, one in fit.items() if one.within is not None}
    of = known or {name: one.gain.value for name, one in fit.items()}
    return float(max(of, key=of.__getitem__)) if of else None


def known_tests(tested: Mapping[str, Any] | None, buffer: ReplayBuffer) -> Tests:
    """Load tested policies as `app.pipeline.training.tested_so_far` has them; none where None."""
    if tested is None:
        return Tests()
    policies = {str(p["id"]): OnnxPolicy(files.read(p["sha256"]), buffer.settings.window) for p in tested["policies"]}
    return Tests(tuple(TestedDifference(**test) for test in tested["tests"]), policies)


def supported_best(buffer: ReplayBuffer, margins: Mapping[str, float] | None, tests: Tests | None = None) -> float | None:
    """Apply `best_supported` to twentieths that are probably within the margins; `margins` as `_judged_by` takes them."""
    limits, _ = _judged_by(margins)
    constants = _gains(buffer, {f"{a:.2f}": ConstantPolicy(a) for a in CONSTANT_GRID}, limits, tests)
    return best_supported(constants, PROBABLY)


def _judged_by(margins: Mapping[str, float] | None) -> tuple[Margins, Levels]:
    """Read the participant's margins, and how sure a verdict must be, from members of both by name; the defaults where None."""
    given = dict(margins or {})
    levels = {name: given.pop(name) for name in ("test_within", "unsafe_beyond") if name in given}
    return Margins(**given), Levels(**levels)


def with_best_anchor(
    configs: Sequence[dict[str, Any]], buffer: ReplayBuffer, margins: Mapping[str, float] | None, tests: Tests | None = None
) -> list[dict[str, Any]]:
    """Replace the anchor `best` in configurations by the amplitude that it means; cDBS where no constant is shown to be better."""
    if not any(one.get("anchor") == BEST for one in configs):
        return list(configs)
    best = supported_best(buffer, margins, tests)
    found = {"anchor": "constant", "anchor_amplitude": 1.0 if best is None else best}
    return [one | found if one.get("anchor") == BEST else one for one in configs]


def hold_out(buffer: ReplayBuffer, wanted: bool, every: int) -> tuple[ReplayBuffer, rl.HeldOutSessions | None]:
    """Split sessions into those to learn from and held-out ones; all and none where they are too few to spare any."""
    if not wanted or len(buffer.sessions) < FEWEST_TO_HOLD_OUT:
        return buffer, None
    learnt, left = rl.split_sessions(buffer)
    # a split may leave nothing to start a score from; then no session is held out
    if not any(s.usable().any() for s in left.sessions) or not learnt.transitions().states.size:
        return buffer, None
    watching = rl.HeldOutSessions(
        sessions=left,
        score=lambda policy: fqe_value(learnt, policy, left.sessions).value,
        score_name="fqe",
        eligible=lambda policy: stays_in_range(policy, learnt),
        every=every,
        patience=6,
    )
    return learnt, watching


def _share_of_end(learnt: ReplayBuffer, config: rl.TrainConfig) -> dict[str, Any]:
    """Describe how well r_end divides into shares of steps, where a policy was to learn from them; null where it learned without."""
    if config.aim != "return":
        return {}
    share = rl.fit_end_reward(learnt)
    return {"end_reward": {"skill": share.skill, "visit_skill": share.visit_skill, "sessions": share.sessions} if share else None}


def stored_gains(
    buffer: ReplayBuffer, policies: Mapping[str, Policy], margins: Mapping[str, float] | None = None, tests: Tests | None = None
) -> dict[str, dict[str, Any] | None]:
    """Compute the gain of each policy over cDBS by the posterior over the whole buffer, in its stored form; None where it cannot be
    estimated.

    The policies have seen most of these sessions, which flatters them. `margins` as `_judged_by` takes them. `tests`: what tested sessions
    showed of other policies; it moves those that act alike.
    """
    limits, levels = _judged_by(margins)
    gains = _gains(buffer, policies, limits, tests)
    return {name: _stored(gains[name], levels) if name in gains else None for name in policies}


def _stored(one: PosteriorGain, levels: Levels) -> dict[str, Any]:
    beyond = None if one.within is None else 1 - one.within >= levels.test_within
    told = {"by": "posterior", "supported": one.supported, "told": one.told, "beyond_margin": beyond}
    return asdict(one.gain) | told | {"within": one.within, "saves": one.saves, "expected_saving": one.expected_saving}


def _gains(buffer: ReplayBuffer, policies: Mapping[str, Policy], margins: Margins, tests: Tests | None) -> dict[str, PosteriorGain]:
    """Compute gains over cDBS; none where the sessions are too few for the posterior."""
    try:
        return gains_over_cdbs(buffer, policies, margins=margins, tests=tests)
    except ValueError:  # what the method says of sessions that it cannot fit
        return {}


def _below_bound(policy: Policy, buffer: ReplayBuffer) -> dict[str, Any]:
    """Compute how often a policy requests less, on the buffer's states, than the random controller was allowed to; null without such a
    session."""
    bound = random_bound(buffer)
    return {"below_bound": None if bound is None else {"bound": bound, "share": share_below_bound(policy, buffer)}}


def _metrics(result: rl.TrainedPolicy, buffer: ReplayBuffer) -> dict[str, Any]:
    """Collect what a trained policy is stored with."""
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
            "saturated": float((abs(actions - 0.5) > 0.5 - rl.SATURATION_MARGIN).mean()),
        },
        "parameters": result.policy.parameter_count,
        "macs": result.policy.macs,
    } | (_below_bound(result.policy, buffer) | _scale_of(result.policy))


def distil(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Distil one policy into a small one.

    Args:
        params: `snapshot_sha256`; `teacher_sha256`, the teacher's ONNX file; `config`, members of `DistilConfig`.
        workdir: gets the student as `policy.onnx`.
        report: the loss over updates.
    """
    buffer = read_buffer(params["snapshot_sha256"])
    given = params["config"]
    try:
        config = rl.DistilConfig(**(given | ({"hidden": tuple(given["hidden"])} if "hidden" in given else {})))
        teacher = OnnxPolicy(files.read(params["teacher_sha256"]), buffer.settings.window)
        result = rl.distil(teacher, buffer, config, report.curves(config.updates), partial(_returns_beside, buffer))
    except (rl.TrainingDiverged, ValueError) as error:
        raise JobError(f"The policy cannot be distilled: {_why(error, report)}.") from error
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
    """Estimate returns of student and teacher by one fitted Q evaluation of the whole buffer, reward units."""
    return {
        "student_return": fqe_value(buffer, student, ()).value,
        "teacher_return": fqe_value(buffer, teacher, ()).value,
    }


def _initial(start: dict[str, str] | None) -> rl.TrainedPolicy | rl.MlpPolicy | None:
    if start is None:
        return None
    if "checkpoint_sha256" in start:
        return rl.TrainedPolicy.from_bytes(files.read(start["checkpoint_sha256"]))
    return rl.MlpPolicy.from_onnx(files.read(start["onnx_sha256"]))


def _with_start(values: dict[str, Any], initial: rl.TrainedPolicy | rl.MlpPolicy | None) -> dict[str, Any]:
    """Change hyper-parameters for a start: fine-tuning keeps layers and the critic's inputs; without its critic, that one learns first."""
    if initial is None:
        return values
    if isinstance(initial, rl.TrainedPolicy):
        seen = {"critic_memory": initial.config.critic_memory} if isinstance(initial.config, rl.CriticConfig) else {}
        return values | {"hidden": list(initial.config.hidden)} | seen
    warmup = {"critic_warmup": values["updates"] // 4} if "critic_lr" in values else {}
    return values | {"hidden": list(initial.hidden)} | warmup


def _scale_of(policy: rl.MlpPolicy) -> dict[str, float]:
    return {"beta_mean": float(policy.mean), "beta_std": float(policy.std)}


def _thinned(values: list[float]) -> list[float]:
    """Select at most `_CURVE_POINTS` of a curve's points, the last one among them."""
    step = -(-len(values) // _CURVE_POINTS)
    return values[::-1][::step][::-1]
