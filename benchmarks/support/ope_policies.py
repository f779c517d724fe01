"""Policies of the evaluation benchmark on the detailed participants: of varying quality, and none of which made the data."""

from __future__ import annotations

from ml.policies.policy import ConstantPolicy, Policy, ProportionalPolicy


def fixed_policies(xi: float) -> dict[str, Policy]:
    """Constants and proportional controllers for a beta threshold xi: the same for every data set of a participant."""
    return {
        "constant 0.40": ConstantPolicy(0.40),
        "constant 0.55": ConstantPolicy(0.55),
        "constant 0.70": ConstantPolicy(0.70),
        "constant 0.85": ConstantPolicy(0.85),
        "proportional fast": ProportionalPolicy(0.7 * xi, 1.2 * xi, 0.35, 2),
        "proportional slow": ProportionalPolicy(0.7 * xi, 1.2 * xi, 0.35, 10),
        "proportional late": ProportionalPolicy(xi, 1.5 * xi, 0.1, 1),
        "nearly off": ConstantPolicy(0.08),
    }
