"""What the child processes of evaluation run: fit one DLSM ensemble member, estimate policies by one method."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.learning.compute import read_buffer, told
from app.platform import files
from app.platform.jobs import Report, compute, write_atomically

if TYPE_CHECKING:
    from ml.ope.dlsm_config import DlsmConfig

FIT_SHARE = 0.5
"""Share of an evaluation step's progress that fitting takes."""


def member_file(k: int) -> str:
    """Name under which the estimator looks for the k-th member of its ensemble."""
    return f"dlsm-member-{k}.pt"


@compute("fit_dlsm")
def fit_dlsm(params: dict[str, Any], workdir: Path, report: Report) -> dict[str, Any]:
    """Train one member of the DLSM ensemble; its file stays in the working folder, where an interrupted training goes on from it.

    Args:
        params: `snapshot_sha256`, `preset`, `seed`, `member`.
        workdir: gets `dlsm-member-K.pt`.
        report: loss and held-out score over gradient steps.

    Returns:
        `held_out` of the best check, or `failed` with the reason where these data cannot be fitted.
    """
    import torch

    from ml.ope.dlsm import Dlsm

    torch.set_num_threads(1)
    buffer = read_buffer(params["snapshot_sha256"])
    estimator = Dlsm(_dlsm_config(params))
    try:
        member = estimator.fit_member(buffer, params["member"], told(report, estimator.config.steps, "dlsm_"), workdir)
    except ValueError as error:
        return {"failed": str(error)}
    return {"held_out_score": float(member.check.score), "checks": len(member.course)}


@compute("evaluate_method")
def evaluate_method(params: dict[str, Any], workdir: Path, report: Report) -> dict[str, Any]:
    """Estimate every policy by one method.

    Args:
        params: `snapshot_sha256`, `preset`, `seed`, `method`, `horizon_steps`, `policies` as [{`id`, `sha256`}], and for the DLSM
            `members`, the stored files of its ensemble; or `failed`, the reason why its ensemble could not be fitted.
        workdir: scratch.
        report: progress.

    Returns:
        `estimates` by policy id, or `failed` with the reason where the method cannot work on these data.
    """
    if "failed" in params:
        return {"failed": params["failed"]}
    import torch

    from ml.ope.dlsm import Dlsm
    from ml.ope.panel import estimators
    from ml.rl.onnx_policy import OnnxPolicy

    torch.set_num_threads(1)
    buffer = read_buffer(params["snapshot_sha256"])
    method = params["method"]
    estimator = Dlsm(_dlsm_config(params)) if method == "dlsm" else estimators(params["seed"], demo=params["preset"] == "quick")[method]
    for k, sha256 in enumerate(params.get("members", [])):
        write_atomically(workdir / member_file(k), files.read(sha256))
    policies = {str(p["id"]): OnnxPolicy(files.read(p["sha256"]), buffer.settings.window) for p in params["policies"]}

    def fitting(fraction: float, message: str = "", **numbers: float) -> None:
        report.progress(FIT_SHARE * fraction, message or "fitting")

    def rolling(fraction: float, message: str = "", **numbers: float) -> None:
        report.progress(FIT_SHARE + (1 - FIT_SHARE) * fraction, message or "estimating")

    try:
        fitted = estimator.fit(buffer, fitting, workdir)
        estimates = fitted.evaluate(policies, params["horizon_steps"], rolling)
    except ValueError as error:
        return {"failed": str(error)}
    return {"estimates": {policy_id: _finite(e.to_json()) for policy_id, e in estimates.items()}}


def dlsm_members(preset: str, seed: int) -> int:
    """Ensemble size of a preset."""
    return _dlsm_config({"preset": preset, "seed": seed}).members


def _dlsm_config(params: dict[str, Any]) -> DlsmConfig:
    from ml.ope.dlsm_config import DlsmConfig

    return DlsmConfig.demo(params["seed"]) if params["preset"] == "quick" else DlsmConfig(seed=params["seed"])


def _finite(value: Any) -> Any:
    """A copy that JSON can hold: what is not a finite number becomes null."""
    if isinstance(value, dict):
        return {name: _finite(v) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
