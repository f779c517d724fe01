"""Answers of a copy to the port vectors of a bundle, as a target would send them."""

from __future__ import annotations

import numpy as np

from ml.deploy.bundle import open_bundle
from ml.deploy.ports.answers import Answers, write_answers
from ml.deploy.ports.check import port_vectors


def port_answers(bundle: bytes, lost_sample: float = np.nan) -> bytes:
    """Write the right answers to complete windows, and the same one to every window with a lost sample."""
    vectors = port_vectors(bundle, open_bundle(bundle).manifest)
    return write_answers(vectors, Answers(np.where(vectors.without_dose, lost_sample, vectors.dose), None))
