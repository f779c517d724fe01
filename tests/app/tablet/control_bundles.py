"""Bundles to try `betaloop control` with, of slots and of none, and its log read back."""

from __future__ import annotations

import csv
import dataclasses
import json
from datetime import datetime
from pathlib import Path

import numpy as np
import torch
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from ml.deploy.bundle import build_bundle, build_scheduled_bundle, sign
from ml.deploy.manifest import Approval, BundleManifest
from ml.deploy.runtime.schedule import Schedule, ScheduledHold
from ml.deploy.runtime.slot import Slot
from ml.rl import MlpPolicy

KEY = Ed25519PrivateKey.from_private_bytes(b"k" * 32)
PUBLIC = KEY.public_key().public_bytes_raw().hex()
MANIFEST = BundleManifest(
    participant="P1", policy_id=3, policy_name="rl-01", window=10, beta_unit="uV", beta_source="time_domain", min_ma=0.5, max_ma=3.0,
    cdbs_ma=3.0, ramp_ma_per_s=0.5, code_version="test", public_key=PUBLIC,
)  # fmt: skip
APPROVAL = Approval(name="ada", role="clinician", approved_at="2026-03-01T09:00:00+00:00", statement="plan 1 of visit 3")
MORNING = datetime.fromisoformat("2026-03-02T09:30:00+00:00")
SLOT = Slot(
    plan_id=1, slot_id=7, position=2, visit_number=3, visit_date="2026-03-02", controller="rl", minutes=5.0, plan_sha256="c" * 64,
    issued_at="2026-03-02T08:00:00+00:00",
)  # fmt: skip
HOLDS = tuple(
    ScheduledHold(start, steps, amplitude, density)
    for start, steps, amplitude, density in [(0, 20, 0.9, -0.3), (20, 30, 0.7, 0.4), (50, 40, 0.8, 0.2), (90, 60, 0.4, -1.1)]
)
SCHEDULE = Schedule("stratified", 0.71, 12, 0.3, HOLDS)


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


def of_slot(folder: Path, **changes: object) -> Path:
    """Build the bundle of a session of a signed plan."""
    return made(folder, **{"slot": SLOT, "approvals": (APPROVAL,), "ramp_ma_per_s": 1.5} | changes)


def scheduled(folder: Path, schedule: Schedule = SCHEDULE, **changes: object) -> Path:
    """Build the bundle of a random session of a signed plan."""
    slot = dataclasses.replace(SLOT, slot_id=8, position=3, controller="random")
    stated = {"slot": slot, "approvals": (APPROVAL,), "ramp_ma_per_s": 1.5, "min_ma": 0.9, "policy_id": None, "policy_name": "stratified"}
    path = folder / "random.zip"
    manifest = dataclasses.replace(MANIFEST, **stated | {"schedule": schedule} | changes)  # type: ignore[arg-type]
    path.write_bytes(sign(build_scheduled_bundle(manifest), KEY))
    return path


def rows_of(log: Path) -> list[dict[str, str]]:
    with log.open(encoding="utf-8") as stream:
        assert next(stream).strip() == "# betaloop controller log, version 3, period 2 s"
        assert json.loads(next(stream).removeprefix("# "))["participant"] == "P1"
        return list(csv.DictReader(stream))
