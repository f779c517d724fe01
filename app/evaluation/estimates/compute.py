"""Child processes of evaluation: check coverage, fit one DLSM ensemble member, estimate, test methods."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from app.evaluation.estimates import dose_shapes
from app.learning.trajectories import read_buffer
from app.platform import files
from app.platform.jobs import StepReport, write_atomically
from app.platform.numbers import number
from ml import progress
from ml.faults import said_of
from ml.loading import load_libraries
from ml.ope import (
    AGGREGATE,
    POSTERIOR,
    Size,
    TestedDifference,
    behaviour_map,
    build,
    diagnose,
    estimators,
    held_out_skill,
    not_counted_tests,
    quick_estimators,
)
from ml.ope.compare.gain import gain_over
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.estimate import Estimate
from ml.ope.posterior.further_sessions import session_noise
from ml.ope.posterior.verdict import Levels, verdict
from ml.outcomes import PREDICTED
from ml.policies.closest_rule import CLOSE, AmplitudeRange, closest_rule
from ml.policies.onnx_policy import OnnxPolicy
from ml.policies.policy import ConstantPolicy, Policy
from ml.policies.threshold_rule import ThresholdPolicy
from ml.qoc import Margins
from ml.trajectories import ReplayBuffer

if TYPE_CHECKING:
    from ml.ope import FittedPosterior, Posterior
    from ml.ope.dlsm.estimator import Dlsm

FIT_SHARE = 0.5
"""Share of an evaluation step's progress that fitting takes."""


def prepare() -> None:
    """Load what the methods use, once, in the process whose forks estimate."""
    load_libraries()
    estimators()


def member_file(k: int) -> str:
    """Name under which the estimator looks for the k-th member of its ensemble."""
    return f"dlsm-member-{k}.pt"


def fit_dlsm(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Train one member of the DLSM ensemble; its file stays in the working folder, where an interrupted training goes on from it.

    Args:
        params: `snapshot_sha256`, `preset`, `seed`, `member`.
        workdir: gets `dlsm-member-K.pt`.
        report: loss and held-out score over gradient steps.

    Returns:
        `held_out_score` of the best check and the number of `checks`, or `failed` with the reason where these data cannot be fitted.
    """
    buffer = read_buffer(params["snapshot_sha256"])
    estimator = cast("Dlsm", build("dlsm", params["seed"], _size(params)))
    try:
        member = estimator.fit_member(buffer, params["member"], report.curves(estimator.config.steps, "dlsm_"), workdir)
    except ValueError as error:
        return {"failed": said_of(error, report.log)}
    report.log(f"member {params['member'] + 1} {_ended(member.course, estimator.config.steps)}")
    return {"held_out_score": float(member.check.score), "checks": len(member.course)}


def _ended(course: Sequence[tuple[int, float, float]], steps: int) -> str:
    """Describe how a member's training ended, from its (update, loss, held-out score) and the updates that it might have taken."""
    last, (best, _, score) = course[-1][0], min(course, key=lambda check: check[2] if math.isfinite(check[2]) else math.inf)
    end = "ran to its last update" if last >= steps else f"was stopped early, at update {last} of {steps}"
    return f"{end}: the best held-out score, {number(score, 4)}, was that of update {best}, which is kept"


def evaluate_method(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Estimate every policy by one method.

    Args:
        params: `snapshot_sha256`, `preset`, `seed`, `method`, `horizon_steps` and `policies` as [{`id`, `sha256`}]. For the DLSM
            `members`, the stored files of its ensemble, or `failed`, the reason why its ensemble could not be fitted. The posterior has
            more, each absent where there is none. `tests`: tested sessions as the fields of `TestedDifference`. `tested`: other
            policies that were tested, which get no estimate. `tests_left_out`: how many sessions are not among the tests, as arguments
            of `not_counted_tests`. `others`: the log evidence by outcome of every participant whose dose shapes are pooled.
        workdir: scratch.
        report: progress, and learning curves where the method trains a network.

    Returns:
        `estimates` by policy id, of the posterior `dose_shapes` too, or `failed` with the reason where the method cannot work on these
        data.
    """
    if "failed" in params:
        return {"failed": params["failed"]}
    buffer = read_buffer(params["snapshot_sha256"])
    estimator = build(params["method"], params["seed"], _size(params))
    tests, left_out = params.get("tests"), not_counted_tests(**params.get("tests_left_out", {}))
    if tests or left_out is not None:
        estimator = cast("Posterior", estimator).with_tests([TestedDifference(**test) for test in tests or ()], left_out)
    if params.get("others") is not None:
        estimator = cast("Posterior", estimator).with_others(params["others"])
    for k, sha256 in enumerate(params.get("members", [])):
        write_atomically(workdir / member_file(k), files.read(sha256))
    policies = _policies([*params["policies"], *params.get("tested", [])], buffer)
    # curves of members that learn one after the other; those of DualDICE learn side by side
    members: int = getattr(estimator, "successive_members", 1)

    def part(first: float, share: float, what: str, curves: bool) -> progress.Report:
        def tell(fraction: float, message: str = "", **numbers: float) -> None:
            report.progress(first + share * fraction, message or what)
            if curves and numbers:
                at, suffix = _of_member(fraction, members)
                report.point(round(100 * at, 3), **{f"{params['method']}_{name}{suffix}": value for name, value in numbers.items()})

        return tell

    # the DLSM has its curves from `fit_dlsm`; here its members are only read
    fitting = part(0.0, FIT_SHARE, "fitting", params["method"] != "dlsm")
    rolling = part(FIT_SHARE, 1 - FIT_SHARE, "estimating", True)
    try:
        fitted = estimator.fit(buffer, fitting, workdir)
        estimates = fitted.evaluate(policies, params["horizon_steps"], rolling)
    except ValueError as error:
        return {"failed": said_of(error, report.log)}
    asked = [str(p["id"]) for p in params["policies"]]
    result: dict[str, Any] = {"estimates": {policy_id: _finite(estimates[policy_id].to_json()) for policy_id in asked}}
    if params["method"] == POSTERIOR:
        result[dose_shapes.STORED] = dose_shapes.found(cast("FittedPosterior", fitted))
    return result


def check_coverage(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Check what the data can say about every policy, whatever the methods say of it.

    Args:
        params: `snapshot_sha256`, `horizon_steps`, `policies` as [{`id`, `sha256`}].
        workdir: not used. report: progress over policies.

    Returns:
        `session_noise`, the standard deviation of each outcome from session to session, and `policies`, by policy id what
        `ml.ope.support.diagnostics.Diagnostics` holds, and `map`, what each asks for at which beta (`BehaviourMap`); or `failed` with the
        reason where these data cannot be checked.
    """
    buffer = read_buffer(params["snapshot_sha256"])
    policies = _policies(params["policies"], buffer)
    try:
        found = diagnose(buffer, policies, params["horizon_steps"], report.curves(1.0))
        drawn = behaviour_map(buffer, policies)
    except ValueError as error:
        return {"failed": said_of(error, report.log), "session_noise": session_noise(buffer)}
    return {
        "policies": {policy_id: _finite(d.to_json()) for policy_id, d in found.items()},
        "map": drawn.to_json(),
        "session_noise": session_noise(buffer),
    }


def choose_method(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Test the methods that are fitted within seconds on held-out controllers.

    Args:
        params: `snapshot_sha256`, `seed`, `methods` asked for, `horizon_steps`, and `policies` that drove logged sessions as
            [{`id`, `sha256`}].
        workdir: not used. report: progress over controllers.

    Returns:
        `held_out`, as `ml.ope.compare.skill.HeldOut` has it, or `failed` with the reason.
    """
    buffer = read_buffer(params["snapshot_sha256"])
    quick = {name: e for name, e in quick_estimators(params["seed"]).items() if name in params["methods"]}
    if not quick:
        return {"failed": "none of the methods asked for is fitted fast enough to leave each controller out in turn"}
    policies = {int(policy_id): policy for policy_id, policy in _policies(params["policies"], buffer).items()}
    try:
        held = held_out_skill(
            buffer,
            quick,
            policies=policies,
            horizon_steps=params["horizon_steps"],
            aggregate=AGGREGATE in params["methods"],
            seed=params["seed"],
            report=report.curves(1.0),
        )
    except ValueError as error:
        return {"failed": said_of(error, report.log)}
    return {"held_out": _finite(held.to_json())}


def dlsm_members(preset: str, seed: int) -> int:
    """Return the ensemble size of a preset."""
    return DlsmConfig.of_size(_size({"preset": preset}), seed).members


def _size(params: dict[str, Any]) -> Size:
    return "demo" if params["preset"] == "quick" else "full"


def _policies(named: list[dict[str, Any]], buffer: ReplayBuffer) -> dict[str, Policy]:
    return {str(p["id"]): OnnxPolicy(files.read(p["sha256"]), buffer.settings.window) for p in named}


def _of_member(fraction: float, members: int) -> tuple[float, str]:
    """Convert a fraction of the whole fit to a fraction of one member's, and the ending of its curve's name."""
    if members == 1:
        return fraction, ""
    k = min(max(math.ceil(fraction * members - 1e-9) - 1, 0), members - 1)
    return fraction * members - k, f"_{k + 1}"


def _finite(value: Any) -> Any:
    """Copy a value for JSON: what is not a finite number becomes null."""
    if isinstance(value, dict):
        return {name: _finite(v) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def find_rule(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Find the closest rule to a policy and estimate rule, policy and cDBS.

    Args:
        params: `snapshot_sha256`, `policy_sha256`, `preset`, `seed`, `horizon_steps`, `cdbs_ma`, `min_ma`, `max_ma`, `step_ma`, `margins`
            and `levels`.
        workdir: not used. report: progress.

    Returns:
        `rule`; `closeness` to the policy; `close`, whether that is close enough; `tried`, the number of rules. `below_threshold`: shares of
        the participant's beta below both thresholds. `estimates` of `rule`, `policy` and `cdbs`; `to_policy` and `to_cdbs`, differences of
        the rule's return; `verdict` on the rule. Or `failed` with the reason where these data give no rule.
    """
    buffer = read_buffer(params["snapshot_sha256"])
    policy = OnnxPolicy(files.read(params["policy_sha256"]), buffer.settings.window)
    limits = AmplitudeRange(params["min_ma"], params["max_ma"], params["step_ma"])
    try:
        found = closest_rule(policy, buffer, params["cdbs_ma"], limits, report.curves(1.0))
        as_policy = ThresholdPolicy(found.rule, params["cdbs_ma"], buffer.settings.period_s)
        report.progress(0.7, "estimating the return")
        panel: dict[str, Policy] = {"rule": as_policy, "policy": policy, "cdbs": ConstantPolicy(1.0)}
        estimates = build(POSTERIOR, params["seed"], _size(params)).fit(buffer).evaluate(panel, params["horizon_steps"])
    except ValueError as error:
        return {"failed": said_of(error, report.log)}
    rule, cdbs = estimates["rule"], estimates["cdbs"]
    judged = verdict(rule, cdbs, Margins(**params["margins"]), Levels(**params["levels"]))
    return {
        "rule": found.rule.to_json(),
        "closeness": asdict(found.closeness),
        "close": found.closeness.rms_ma <= CLOSE * params["cdbs_ma"],
        "tried": found.tried,
        "below_threshold": [_share_below(buffer, t) for t in (found.rule.lower_threshold, found.rule.upper_threshold)],
        "estimates": {name: _rule_numbers(estimate) for name, estimate in estimates.items()},
        "to_policy": _difference(rule, estimates["policy"]),
        "to_cdbs": _difference(rule, cdbs),
        "verdict": {"code": judged.code, "within": judged.within},
        "horizon_steps": params["horizon_steps"],
    }


def _share_below(buffer: ReplayBuffer, threshold: float) -> float:
    beta = np.concatenate([s.measured_beta for s in buffer.sessions])
    return float(np.mean(beta[np.isfinite(beta)] <= threshold))


def _rule_numbers(estimate: Estimate) -> dict[str, Any]:
    named = {"energy", "mean_amplitude", *(o.field for o, _ in PREDICTED)}
    return {
        "value": estimate.value,
        "low": estimate.low,
        "high": estimate.high,
        "supported": estimate.supported,
        "predicted": {name: value for name, value in estimate.predicted.items() if name in named and np.isfinite(value)},
    }


def _difference(own: Estimate, other: Estimate) -> dict[str, float]:
    gain = gain_over(own, other)
    return {"value": gain.value, "low": gain.low, "high": gain.high}
