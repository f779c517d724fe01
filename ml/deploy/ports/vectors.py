"""The file `port-vectors.csv` of a bundle: 400 windows, the dose due to each, and what must not happen."""

from __future__ import annotations

import csv
import hashlib
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.deploy.manifest import BundleError, BundleManifest
from ml.deploy.ports import windows as kinds
from ml.deploy.ports.lost_sample import MODEL_LOST, with_lost_samples
from ml.deploy.ports.windows import COUNT, LOST, Act, Recorded, Windows, choose_windows
from ml.deploy.runtime.controller import BoundedController
from ml.deploy.runtime.envelope import BetaSample, Signal
from ml.policies.onnx_policy import OnnxPolicy, PolicyFileError, PolicyOutputError

PORT_VECTORS = "port-vectors.csv"
ROW, HASH, KIND, DOSE, DECISION, MUST_NOT = "row", "hash", "kind", "network_dose", "decision_ma", "must_not"
HASH_DIGITS = 12


@dataclass(frozen=True)
class PortVectors:
    """Windows with what is due to them.

    Attributes:
        kind: of each window. hashes: of each row, 12 hexadecimal digits. windows: [400, W], NaN where a sample is lost.
        dose: of the network, amplitude fraction [400]; NaN where no answer may count as a dose.
        decision_ma: of the whole decision after the window was played to a controller that has just started, mA [400].
        must_not: what must not happen, in words.
    """

    kind: tuple[str, ...]
    hashes: tuple[str, ...]
    windows: Windows
    dose: NDArray[np.float64]
    decision_ma: NDArray[np.float64]
    must_not: tuple[str, ...]

    @property
    def without_dose(self) -> NDArray[np.bool_]:
        """Mark windows for which no number may count as a dose of the network, [400]: those with a lost sample."""
        return np.isnan(self.dose)


def port_files(manifest: BundleManifest, policy: OnnxPolicy, visits: Sequence[Recorded], controller: BoundedController) -> dict[str, bytes]:
    """Make the files of a bundle for ports: the vectors, and the network in which a lost sample reaches the answer.

    The second file is missing where the graph cannot be added to.

    Args:
        manifest: with limits and the unit and source of beta. policy: the network.
        visits: complete beta windows by visit. controller: network and envelope.
    """
    act = _doses_of(policy)
    made = make_vectors(manifest, hashlib.sha256(policy.content).hexdigest(), visits, act, controller)
    files = {PORT_VECTORS: to_csv(made)}
    try:
        lost = with_lost_samples(policy.content)
        due = made.windows[~np.isnan(made.dose)]
        if np.array_equal(OnnxPolicy(lost, policy.window).act(due), act(due)):
            files[MODEL_LOST] = lost
    except (ValueError, PolicyFileError, PolicyOutputError):
        return files  # a graph that cannot be added to leaves as it is, without the second file
    return files


def _doses_of(policy: OnnxPolicy) -> Act:
    """Make a function that answers NaN where the policy gives no amplitude fraction."""

    def act(windows: Windows) -> NDArray[np.float64]:
        try:
            return policy.act(windows)
        except PolicyOutputError:
            return np.array([_one(policy, window) for window in windows])

    return act


def _one(policy: OnnxPolicy, window: NDArray[np.float64]) -> float:
    try:
        return float(policy.act(window[None, :])[0])
    except PolicyOutputError:
        return math.nan


def make_vectors(
    manifest: BundleManifest, model_sha256: str, visits: Sequence[Recorded], act: Act, controller: BoundedController
) -> PortVectors:
    """Make the vectors of a bundle.

    Args:
        manifest: with limits and the unit and source of beta. model_sha256: of the ONNX file.
        visits: complete beta windows by visit. act: the network. controller: network and envelope.
    """
    kind, windows = choose_windows(visits, act)
    whole = ~np.isnan(windows).any(axis=1)
    dose = np.full(len(windows), np.nan)
    dose[whole] = act(windows[whole])
    decision_ma = np.array([run_window(controller, manifest, window) for window in windows])
    hashes = tuple(row_hash(model_sha256, row, window) for row, window in enumerate(windows, 1))
    must_not = tuple(_must_not(name, manifest, due) for name, due in zip(kind, decision_ma.tolist(), strict=True))
    return PortVectors(tuple(kind), hashes, windows, dose, decision_ma, must_not)


def run_window(controller: BoundedController, manifest: BundleManifest, window: NDArray[np.float64]) -> float:
    """Run a window through a controller that has just started, one value per period. Returns the last decision's amplitude, mA."""
    fresh, signal = controller.fresh(), Signal(manifest.beta_unit, manifest.beta_source)
    amplitude = manifest.cdbs_ma
    for step, beta in enumerate(window.tolist()):
        now_s = step * manifest.period_s
        amplitude = fresh.decide(now_s, BetaSample(now_s, beta, signal)).amplitude_ma
    return float(amplitude)


def row_hash(model_sha256: str, row: int, window: NDArray[np.float64]) -> str:
    """Hash a row: of which network, which place in the file, which float32 values."""
    return hashlib.sha256(f"{model_sha256}:{row}:".encode() + window.astype("<f4").tobytes()).hexdigest()[:HASH_DIGITS]


def _must_not(kind: str, m: BundleManifest, due_ma: float) -> str:
    """Say what must not happen with a window of a kind; without commas, for the simplest of readers."""
    if kind in LOST:
        guard = f"{m.cdbs_ma:g} mA" if due_ma == m.cdbs_ma else f"{due_ma:.4g} mA with the lost ones imputed"
        return f"an ordinary dose: no number from the network or {guard} from the guard in front of it"
    return {
        kinds.ZERO: "a fault of arithmetic or a dose for what was never measured",
        kinds.LEVEL: "a fall where the policy rises or a rise where it falls",
        kinds.STEP: "the dose of the mirrored step: a window read in another order",
        kinds.PULSE: "the dose of a pulse elsewhere: a window read in another order",
        kinds.LARGE: "a number that wraps to the other sign or a dose outside 0 to 1",
        kinds.LOWEST: "more than this dose: the least dose is out of reach",
        kinds.HIGHEST: "less than this dose: the full dose is out of reach",
    }.get(kind, "another dose")


def to_csv(vectors: PortVectors) -> bytes:
    """Write the file; the same vectors always give the same bytes."""
    sink = io.StringIO()
    writer = csv.writer(sink, lineterminator="\n")
    betas = [f"beta_{place}" for place in range(1, vectors.windows.shape[1] + 1)]
    writer.writerow([ROW, HASH, KIND, *betas, DOSE, DECISION, MUST_NOT])
    for i, window in enumerate(vectors.windows):
        doses = [number_text(vectors.dose[i]), number_text(vectors.decision_ma[i])]
        writer.writerow([i + 1, vectors.hashes[i], vectors.kind[i], *map(number_text, window), *doses, vectors.must_not[i]])
    return sink.getvalue().encode()


def number_text(value: float) -> str:
    """Write a float32 so that it reads back as the same number; `nan` for none."""
    return "nan" if math.isnan(value) else f"{value:.9g}"


def from_csv(content: bytes, window: int) -> PortVectors:
    """Read what `to_csv` wrote. Raises BundleError for another file."""
    rows = list(csv.reader(io.StringIO(content.decode("utf-8", "replace"))))
    if len(rows) != COUNT + 1 or any(len(row) != window + 6 for row in rows):
        raise BundleError(f"{PORT_VECTORS} does not hold {COUNT} windows of {window} values")
    try:
        numbers = np.array([row[3 : 3 + window + 2] for row in rows[1:]], dtype=np.float64)
    except ValueError as error:
        raise BundleError(f"{PORT_VECTORS} cannot be read: {error}") from error
    columns = list(zip(*rows[1:], strict=True))
    return PortVectors(
        columns[2], columns[1], numbers[:, :window].astype(np.float32).astype(np.float64), numbers[:, -2], numbers[:, -1], columns[-1]
    )
