"""Weights that members of a DLSM start from: fitted to virtual patients of part A, never to a participant.

    python -m benchmarks.development.dlsm_pretraining        makes the file anew

Training on simulated truth is an exception that is made here alone. The file holds the weights of one residual model, whose targets are
what a linear part leaves in units of its noise, so that they mean the same in every participant.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.networks import DlsmNetworks

FORMAT = 1
"""Raised when what the weights mean changes; a file of another format is refused."""

PATH = Path(__file__).parent / "weights" / "pretrained.npz"
REBUILD = "make it anew with `python -m benchmarks.development.dlsm_pretraining`"
SHAPE = (
    "latent",
    "hidden",
    "heads",
    "state_terms",
    "action_emission",
    "end_features",
    "skip",
    "residual",
    "reward_terms",
    "recurrent_heads",
)
"""Settings that must be those of the file's model."""


def shape_of(config: DlsmConfig, window: int) -> dict[str, Any]:
    """What weights must fit, JSON-able."""
    found = {name: getattr(config, name) for name in SHAPE}
    return json.loads(json.dumps(found | {"window": window}))


def fingerprint(path: Path = PATH) -> str:
    """Names the file's content; empty where there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else ""


def save(networks: DlsmNetworks, path: Path, made_from: str) -> None:
    """Write a model's weights; `made_from` says what it was fitted to."""
    about = {"format": FORMAT, "shape": shape_of(networks.config, networks.window), "made_from": made_from}
    weights = {name: value.numpy().astype(np.float32) for name, value in networks.state_dict().items()}
    np.savez_compressed(path, about=np.array(json.dumps(about)), **weights)


def start(networks: DlsmNetworks, path: Path = PATH) -> bool:
    """Give a model the weights of the file; False, and nothing is changed, where its states have another window than the file's.

    Raises:
        ValueError: the file is missing, of another format, or its model has another shape; the message says how to mend it.
    """
    if not path.exists():
        raise ValueError(f"the constants that the DLSM starts from, {path.name}, are missing: {REBUILD}")
    with np.load(path, allow_pickle=False) as stored:
        about = json.loads(str(stored["about"]))
        if about["format"] != FORMAT:
            raise ValueError(f"{path.name} has format {about['format']}, and this betaloop reads format {FORMAT}: {REBUILD}")
        ours = shape_of(networks.config, networks.window)
        if about["shape"]["window"] != ours["window"]:
            return False
        if about["shape"] != ours:
            other = ", ".join(f"{k} {about['shape'].get(k)} and not {v}" for k, v in ours.items() if about["shape"].get(k) != v)
            raise ValueError(f"{path.name} is of a DLSM with {other}: set pretrained=False, or {REBUILD}")
        networks.load_state_dict({name: torch.from_numpy(stored[name]) for name in stored.files if name != "about"})
    return True
