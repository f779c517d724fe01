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
from ml.deploy.ports.answers import AnswersError
from ml.deploy.ports.check import check_file
from ml.deploy.ports.windows import Recorded
from ml.policies.onnx_policy import PolicyFileError


def make(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Make and sign a bundle, which runs its policy to check it, or make only its manifest.

    Args:
        params: `file` (path of the policy), `manifest` (its JSON text), `windows` (list [M, W]), `target`: the file to write the bundle to,
            None for the manifest alone. `visits`: kind and windows of each, for the port vectors. `secrets` and `key`: the folder of
            keys, and the name of the one to sign with.
        workdir, report: not used.

    Returns:
        `manifest`, its JSON text, where no bundle was asked for; `refused`, which says why there is none.
    """
    policy, windows = Path(params["file"]).read_bytes(), np.asarray(params["windows"], dtype=np.float64)
    manifest = BundleManifest.from_bytes(params["manifest"].encode())
    try:
        if params["target"] is None:
            return {"manifest": describe(policy, manifest, windows).to_bytes().decode()}
        visits = [Recorded(kind, np.asarray(rows, dtype=np.float64)) for kind, rows in params["visits"]]
        key = Ed25519PrivateKey.from_private_bytes(stored_secret(Path(params["secrets"]), params["key"]))
        Path(params["target"]).write_bytes(sign(build_bundle(policy, manifest, windows, visits), key))
    except (BundleError, PolicyFileError) as error:
        return {"refused": str(error)}
    return {}


def check_port(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Check the answers of a converted copy, which runs the bundle's policy.

    Args:
        params: `bundle` and `answers`, paths of the files. workdir, report: not used.

    Returns:
        `check`, the result as JSON; or `refused` and `hint`, which say why there is none.
    """
    try:
        return {"check": check_file(Path(params["bundle"]).read_bytes(), Path(params["answers"]).read_bytes()).to_json()}
    except AnswersError as error:
        return {"refused": str(error), "hint": error.hint}
