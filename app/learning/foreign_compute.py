"""Opening and running of a foreign policy file. Runs in a limited child, never in the web process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from app.platform.jobs import StepReport
from ml.policies.onnx_policy import OnnxPolicy, PolicyFileError


def judge(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Try a policy on beta windows of many scales.

    Args:
        params: `file` (path), `window` (W), `probe`: further windows, a list [M, W], or None.
        workdir, report: not used.

    Returns:
        `refused`, which says why the file is no policy, or nothing.
    """
    probe = None if params["probe"] is None else np.asarray(params["probe"], dtype=np.float64)
    try:
        OnnxPolicy(Path(params["file"]).read_bytes(), params["window"], probe)
    except PolicyFileError as error:
        return {"refused": str(error)}
    return {}
