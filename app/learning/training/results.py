"""Names of the files that training steps leave in their folders."""

from __future__ import annotations

POLICY, CLONE = "policy.onnx", "clone.onnx"


def policy_file(member: int) -> str:
    """Name a trained policy's file in the folder of its step."""
    return f"policy-{member}.onnx"


def training_file(member: int) -> str:
    """Name a whole training's file in the folder of its step."""
    return f"training-{member}.pt"
