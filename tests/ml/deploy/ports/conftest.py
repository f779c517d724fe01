from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from ml.deploy.bundle import OpenBundle, build_bundle, open_bundle
from ml.deploy.ports.answers import Answers, write_answers
from ml.deploy.ports.check import PortCheck, check_port, port_vectors
from ml.deploy.ports.vectors import PortVectors
from ml.deploy.ports.windows import Recorded
from ml.rl import MlpPolicy


@dataclass(frozen=True)
class Ported:
    """A bundle with its vectors, and the check of answers to them."""

    policy: MlpPolicy
    content: bytes
    opened: OpenBundle
    vectors: PortVectors

    def answers(self, windows=None) -> np.ndarray:
        """Compute the policy's own answers, NaN for windows with a lost sample."""
        return self.policy.act(self.vectors.windows if windows is None else windows)

    def check(self, fraction, decided_ma=None) -> PortCheck:
        """Check answers through the table that a target writes."""
        table = write_answers(self.vectors, Answers(None if fraction is None else np.asarray(fraction), decided_ma))
        return check_port(self.content, self.opened, table)


def make_port(manifest, mean, std, *, gain=1000.0) -> Ported:
    """Make a bundle whose network takes beta of a mean and standard deviation, with three recorded visits."""
    policy = MlpPolicy(10, (20, 10), mean=mean, std=std, seed=3)
    with torch.no_grad():
        policy.layers[-1].weight.mul_(gain)
    rng = np.random.default_rng(0)
    recorded = [Recorded(f"visit {number}", np.abs(rng.normal(mean, std, (size, 10)))) for number, size in ((1, 300), (2, 40), (3, 200))]
    stated = replace(
        manifest, normalisation_mean=mean, normalisation_std=std, test_windows_from="snapshot 1",
        beta_max=8 * mean, level_low=mean / 4, level_high=4 * mean,
    )  # fmt: skip
    content = build_bundle(policy.to_onnx(), stated, recorded[0].windows[:16], recorded)
    opened = open_bundle(content)
    return Ported(policy, content, opened, port_vectors(content, opened.manifest))


@pytest.fixture(scope="session")
def port(manifest) -> Ported:
    return make_port(manifest, 30.0, 9.0)


@pytest.fixture(scope="session")
def large_port(manifest) -> Ported:
    """Beta is a power, of the order of a million."""
    return make_port(manifest, 1.2e6, 3.5e5)
