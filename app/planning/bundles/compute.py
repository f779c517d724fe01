"""Bundles of policies made elsewhere, whose making runs the policy: in a limited child, never in the web process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.platform.jobs import StepReport
from app.settings import stored_secret
from ml.deploy.bundle import build_bundle, describe, sign
from ml.deploy.manifest import BundleError, BundleManifest
from ml.policies.onnx_policy import PolicyFileError


def make(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Make and sign a bundle, which runs its policy to check it, or make only its manifest.

    Args:
        params: `file` (path of the policy), `manifest` (its JSON text), `windows` (list [M, W]), `target`: the file to write the bundle to,
            None for the manifest alone; `secrets` and `key`: the folder of keys, and the name of the one to sign with.
        workdir, report: not used.

    Returns:
        `manifest`, its JSON text, where no bundle was asked for; `refused`, which says why there is none.
    """
    policy, windows = Path(params["file"]).read_bytes(), np.asarray(params["windows"], dtype=np.float64)
    manifest = BundleManifest.from_bytes(params["manifest"].encode())
    try:
        if params["target"] is None:
            return {"manifest": describe(policy, manifest, windows).to_bytes().decode()}
        key = Ed25519PrivateKey.from_private_bytes(stored_secret(Path(params["secrets"]), params["key"]))
        Path(params["target"]).write_bytes(sign(build_bundle(policy, manifest, windows), key))
    except (BundleError, PolicyFileError) as error:
        return {"refused": str(error)}
    return {}
