"""The eight policies of the evaluation benchmark: of varying quality, and none of which made the data."""

from __future__ import annotations

from pathlib import Path

from ml.policies.onnx_policy import OnnxPolicy
from ml.policies.policy import ConstantPolicy, Policy, ProportionalPolicy
from ml.rl import ALGORITHMS, DistilConfig, distil, train
from ml.trajectories import ReplayBuffer

SMALL = {"hidden": (64, 48), "updates": 3000, "batch": 64, "actor_lr": 3e-4}


def fixed_policies(xi: float, *, quick: bool = False) -> dict[str, Policy]:
    """Constants and proportional controllers: the same for every data set of a world."""
    found: dict[str, Policy] = {
        "constant 0.40": ConstantPolicy(0.40),
        "constant 0.70": ConstantPolicy(0.70),
        "proportional fast": ProportionalPolicy(0.7 * xi, 1.2 * xi, 0.35, 2),
        "proportional late": ProportionalPolicy(xi, 1.5 * xi, 0.1, 1),
    }
    return found if quick else {**found, "constant 0.85": ConstantPolicy(0.85)}


def trained_policies(buffer: ReplayBuffer, seed: int, folder: Path) -> dict[str, Policy]:
    """Three that learned from the data, by three algorithms, one of them distilled; kept as ONNX files and not trained again."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {name: folder / f"{name}.onnx" for name in ("ddpg", "rebrac", "td3_bc distilled")}
    if not all(f.exists() for f in files.values()):
        for k, (name, changes) in enumerate((("ddpg", {}), ("rebrac", {"aim": "return"}), ("td3_bc", {"aim": "return"}))):
            algorithm = ALGORITHMS[name]
            policy = train(buffer, algorithm.config(**SMALL, **changes, seed=seed + k)).policy
            if name == "td3_bc":
                policy = distil(policy, buffer, DistilConfig(updates=1000, sigma=0.6, seed=seed)).policy
                name = "td3_bc distilled"
            files[name].write_bytes(policy.to_onnx())
    return {name: OnnxPolicy(f.read_bytes(), buffer.settings.window) for name, f in files.items()}
