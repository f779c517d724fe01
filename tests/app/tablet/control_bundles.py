"""Bundles to try `betaloop control` with, and its log read back."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
import torch
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from ml.deploy.bundle import build_bundle, sign
from ml.deploy.manifest import BundleManifest
from ml.rl import MlpPolicy

KEY = Ed25519PrivateKey.from_private_bytes(b"k" * 32)
PUBLIC = KEY.public_key().public_bytes_raw().hex()
MANIFEST = BundleManifest(
    participant="P1", policy_id=3, policy_name="rl-01", window=10, beta_unit="uV", beta_source="time_domain", min_ma=0.5, max_ma=3.0,
    cdbs_ma=3.0, ramp_ma_per_s=0.5, code_version="test", public_key=PUBLIC,
)  # fmt: skip


def made(folder: Path, **changes: object) -> Path:
    policy = MlpPolicy(int(str(changes.get("window", 10))), (20, 10), mean=1.4, std=1.0, seed=3)
    with torch.no_grad():
        policy.layers[-1].weight.mul_(200)
    manifest = dataclasses.replace(MANIFEST, **changes)  # type: ignore[arg-type]
    path = folder / "bundle.zip"
    path.write_bytes(
        sign(build_bundle(policy.to_onnx(), manifest, np.abs(np.random.default_rng(0).normal(1.4, 1, (8, manifest.window)))), KEY)
    )
    return path


def rows_of(log: Path) -> list[dict[str, str]]:
    with log.open(encoding="utf-8") as stream:
        assert next(stream).startswith("# betaloop controller log, version 2, period 2 s, policy 3, ")
        return list(csv.DictReader(stream))
