"""Runs policies over recorded beta, with the loop that the tablet runs. In a limited child, never in the web process."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from app.platform.jobs import StepReport
from ml.deploy.runtime.controller import BoundedController
from ml.deploy.runtime.envelope import BetaSample, EnvelopeLimits, Signal
from ml.deploy.windows import PolicyWindow
from ml.policies.onnx_policy import OnnxPolicy, PolicyFileError


def ask(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Compute what each policy requests before every step.

    Args:
        params: `policies` as [{`id`, `file` (path)}], `window` (W), `period_s`, `beta`: one value per period or None, the W before the
            session first.
        workdir, report: not used.

    Returns:
        `asked`: by policy id a fraction of the cDBS amplitude for every step, None where the loop would have gone back to cDBS because no
        whole window of beta had come; or `refused`: by policy id why its file cannot be run.
    """
    asked: dict[str, list[float | None]] = {}
    refused: dict[str, str] = {}
    for policy in params["policies"]:
        try:
            network = PolicyWindow(OnnxPolicy(Path(policy["file"]).read_bytes(), params["window"]), params["window"])
        except PolicyFileError as error:
            refused[str(policy["id"])] = str(error)
            continue
        asked[str(policy["id"])] = run(network, params["beta"], params["window"], params["period_s"])
    return {"asked": asked, "refused": refused}


def run(network: PolicyWindow, beta: list[float | None], window: int, period_s: float) -> list[float | None]:
    """Run one policy in the tablet's loop. `beta` [W + T] as in `ask`; the answers of steps 0 to T - 1."""
    signal = Signal("recorded", "recorded")  # units were compared before
    limits = EnvelopeLimits(min_ma=0.0, max_ma=1.0, cdbs_ma=1.0, ramp_ma_per_s=1.0 / period_s, window=window, period_s=period_s)
    loop = BoundedController(network, limits, signal)
    answers: list[float | None] = []
    for k, value in enumerate(beta[:-1]):
        now_s = k * period_s
        decision = loop.decide(now_s, BetaSample(now_s, math.nan if value is None else value, signal))
        if k >= window - 1:
            answers.append(None if decision.fallback else decision.fraction)
    return answers
