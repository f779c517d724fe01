"""Bundles of policies made elsewhere, whose making runs the policy: in a limited child, never in the web process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from app.platform.jobs import StepReport
from ml.deploy.bundle import build_bundle, describe
from ml.deploy.manifest import BundleError, BundleManifest
from ml.policies.onnx_policy import PolicyFileError


def make(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Make a bundle, or only its manifest.

    Args:
        params: `file` (path of the policy), `manifest` (its JSON text), `windows` (list [M, W]), `target`: the file to write the bundle to,
            None for the manifest alone.
        workdir, report: not used.

    Returns:
        `manifest`, its JSON text, where no bundle was asked for; `refused`, which says why there is none.
    """
    policy, windows = Path(params["file"]).read_bytes(), np.asarray(params["windows"], dtype=np.float64)
    manifest = BundleManifest.from_bytes(params["manifest"].encode())
    try:
        if params["target"] is None:
            return {"manifest": describe(policy, manifest, windows).to_bytes().decode()}
        Path(params["target"]).write_bytes(build_bundle(policy, manifest, windows))
    except (BundleError, PolicyFileError) as error:
        return {"refused": str(error)}
    return {}
