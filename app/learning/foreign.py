"""Policies made elsewhere are programs of strangers: they are opened and run in limited children alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.platform import files
from app.platform.jobs.children.child import ChildLimits
from app.platform.jobs.children.limited import ChildEnded, run_limited
from ml.policies.onnx_policy import PolicyFileError

JUDGE = "app.learning.foreign_compute:judge"
LIMITS = ChildLimits(memory_mb=1024, cpu_s=10, quotes=False)
"""A policy of the study's kind needs 60 MiB, with onnxruntime, and milliseconds."""

LONGEST_REASON = 400
"""Characters of a refusal that are shown; onnxruntime lists whole graphs."""


def judge(content: bytes, window: int, probe: NDArray[np.float64] | None) -> None:
    """Try a policy file in a child.

    Args:
        content: the ONNX file.
        window: W that the participant uses.
        probe: further beta windows to try, shape [M, W].

    Raises:
        PolicyFileError: the file is no policy that betaloop can run; says why.
    """
    with files.draft_folder() as folder:
        (folder / "policy.onnx").write_bytes(content)
        params = {"file": str(folder / "policy.onnx"), "window": window, "probe": None if probe is None else probe.tolist()}
        found = run(JUDGE, params)
    if "refused" in found:
        reason = found["refused"]
        raise PolicyFileError(reason if len(reason) <= LONGEST_REASON else f"{reason[:LONGEST_REASON]} …")


def run(reference: str, params: dict[str, Any]) -> dict[str, Any]:
    """Call a function on a policy made elsewhere in a child. Raises PolicyFileError where it meets a limit or ends the child."""
    try:
        return run_limited(reference, params, LIMITS, who="policies")
    except ChildEnded as ended:
        reasons = {
            "memory": f"it needs more memory than the {LIMITS.memory_mb} MiB that a policy may have",
            "time": f"it needs more than the {LIMITS.cpu_s} s of processor time that trying a policy may take",
            "killed": "running it ends the process that runs it",
            "error": "trying it failed",
        }
        raise PolicyFileError(reasons[ended.cause]) from ended
