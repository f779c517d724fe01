"""The controller bundle: one ZIP that carries a policy from the study to the tablet or an implant, and proves that it arrived whole.

    sheet.html                    the one-page sheet for the clinician, to be printed
    manifest.json, manifest.sig   whose, for which signal, within which limits; SHA-256 of every file; its Ed25519 signature
    model.onnx                    the network: beta_window [N, W] to amplitude_fraction [N, 1]
    test_vectors.json             what every runtime must answer, and one session with everything that can go wrong with beta
    port-vectors.csv              400 windows with their doses, by which a converted copy is checked (`ml.deploy.ports`)
    model-lost-sample.onnx        the network again: a lost sample reaches its answer by arithmetic, where its graph can be added to
  and for plain multi-layer perceptrons, as betaloop trains them and as many a file made elsewhere is one:
    weights.f32, controller/      the reference runner: `python -m controller`, Python and numpy alone
    betaloop_controller.h         the whole controller in C99, float32; selftest.c checks it
    betaloop_controller_int8.h    the same in whole numbers, for small networks; selftest_int8.c checks it
  of a blinded session there are sheet, manifest, signature and runner, and one sealed file with the rest (`ml.deploy.blinding`)

The bytes of a bundle depend on its contents alone: no times, fixed order, no compression (its output differs between zlib versions).
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from numpy.typing import NDArray

from ml.deploy import appraisal, vectors
from ml.deploy.c_envelope import header_tanh
from ml.deploy.c_header import fixed_point_header, float_header, self_test
from ml.deploy.fixed_point import CutNetwork, quantise
from ml.deploy.manifest import BundleError, BundleManifest
from ml.deploy.onnx_mlp import NoPlainNetwork, mlp_of
from ml.deploy.ports.lost_sample import MODEL_LOST
from ml.deploy.ports.vectors import PORT_VECTORS, port_files
from ml.deploy.ports.windows import MADE_UP, Recorded
from ml.deploy.runtime.__main__ import check
from ml.deploy.runtime.controller import BoundedController, WindowNetwork
from ml.deploy.runtime.envelope import Signal
from ml.deploy.runtime.network import MlpNetwork
from ml.deploy.runtime.schedule import ScheduledController
from ml.deploy.runtime.slot import SEALED, same_session, unseal
from ml.deploy.sheet import render
from ml.deploy.windows import PolicyWindow
from ml.policies.onnx_policy import MAX_FILE_BYTES, OnnxPolicy, PolicyFileError, PolicyOutputError

SHEET, MANIFEST, SIGNATURE, MODEL, VECTORS = "sheet.html", "manifest.json", "manifest.sig", "model.onnx", "test_vectors.json"
WEIGHTS, HEADER, SELF_TEST = "weights.f32", "betaloop_controller.h", "selftest.c"
HEADER_INT8, SELF_TEST_INT8 = "betaloop_controller_int8.h", "selftest_int8.c"
_RUNTIME = Path(__file__).parent / "runtime"
RUNNER = tuple(f"controller/{path.name}" for path in sorted(_RUNTIME.glob("*.py")))
_REQUIRED = {SHEET, VECTORS}
_OF_NETWORKS = {WEIGHTS, HEADER, SELF_TEST}
_OF_SMALL_NETWORKS = {HEADER_INT8, SELF_TEST_INT8}
_OF_PORTS = {PORT_VECTORS, MODEL_LOST}
"""Files that bundles of earlier versions lack."""
_ORDER = (
    SHEET, MANIFEST, SIGNATURE, MODEL, MODEL_LOST, VECTORS, PORT_VECTORS, WEIGHTS, HEADER, SELF_TEST, HEADER_INT8, SELF_TEST_INT8, SEALED,
    *RUNNER,
)  # fmt: skip
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time a ZIP can hold


@dataclass(frozen=True)
class OpenBundle:
    """A bundle that has been verified.

    Attributes:
        manifest: what it says about itself.
        network: keeps its own window; in numpy, or by onnxruntime for a policy made elsewhere. None where a schedule runs.
        manifest_sha256: of its bytes, which names the bundle in logs.
    """

    manifest: BundleManifest
    network: WindowNetwork | None
    manifest_sha256: str

    @property
    def manifest_json(self) -> dict[str, Any]:
        """The manifest as the runner on the tablet reads it."""
        return dict(json.loads(self.manifest.to_bytes()))

    def controller(self) -> BoundedController:
        """Make the network or the schedule within the clinician's limits; one per session."""
        return make_controller(self.manifest, self.network)


def build_bundle(policy_onnx: bytes, manifest: BundleManifest, test_windows: NDArray[Any], visits: Sequence[Recorded] = ()) -> bytes:
    """Pack a policy.

    Args:
        policy_onnx: the network.
        manifest: everything but the layers, the facts of the fixed-point header and `files`, which are filled in here.
        test_windows: beta windows for the test vectors, shape [M, W], M at least 1, finite; windows at the edges are added.
        visits: beta windows of each visit for the port vectors; the test windows when empty.

    Returns:
        The ZIP's bytes, the same for the same arguments.

    Raises:
        PolicyFileError: the network is no policy of this window.
        BundleError: test windows of another shape, or not finite.
    """
    manifest, network, policy, windows = _complete(policy_onnx, manifest, test_windows)
    expected = policy.act(windows)
    controller = make_controller(manifest, network or PolicyWindow(policy, manifest.window))
    steps = vectors.session(manifest, controller, windows)
    files = {MODEL: policy_onnx, VECTORS: vectors.to_json(windows, expected, steps)}
    known = visits or [Recorded("recorded" if manifest.test_windows_from else MADE_UP, np.asarray(test_windows, dtype=np.float64))]
    files |= port_files(manifest, policy, known, controller)
    if network is not None:
        files |= _runner_files()
        test = self_test(manifest, HEADER, windows, expected, steps, vectors.TOLERANCE, exact=True)
        files |= {WEIGHTS: network.to_bytes(), HEADER: float_header(manifest, network).encode(), SELF_TEST: test.encode()}
        fixed = quantise(network)
        if fixed is not None:
            expected_cut = policy.act(fixed.cut(windows))  # the bound is against the real network on the window cut to the int16 inputs
            steps = vectors.session(manifest, make_controller(manifest, CutNetwork(network, fixed)), windows)
            test = self_test(manifest, HEADER_INT8, windows, expected_cut, steps, fixed.bound, exact=False)
            files |= {HEADER_INT8: fixed_point_header(manifest, fixed).encode(), SELF_TEST_INT8: test.encode()}
    return _whole(manifest, files, render(manifest, hashlib.sha256(policy_onnx).hexdigest()))


def build_scheduled_bundle(manifest: BundleManifest) -> bytes:
    """Pack a session whose amplitudes are laid out beforehand: sheet, reference runner, and the session in which beta goes wrong.

    Args:
        manifest: everything but `files`; with a schedule.

    Returns:
        The ZIP's bytes, the same for the same manifest.
    """
    level = manifest.level_high / 2 if manifest.level_high else 1.0
    betas = level * np.linspace(0.8, 1.2, 16)[:, None] * np.linspace(0.9, 1.1, manifest.window)[None, :]
    steps = vectors.session(manifest, make_controller(manifest, None), betas)
    files = {VECTORS: vectors.to_json(np.empty((0, manifest.window)), np.empty(0), steps)} | _runner_files()
    return _whole(manifest, files, render(manifest, None))


def make_controller(manifest: BundleManifest, network: WindowNetwork | None) -> BoundedController:
    """Make a controller of a network, or of the manifest's schedule, within the clinician's limits. Raises BundleError where there is
    neither."""
    signal = Signal(manifest.beta_unit, manifest.beta_source)
    if manifest.schedule is not None:
        return ScheduledController(manifest.schedule, manifest.limits(), signal)
    if network is None:
        raise BundleError("the bundle has neither network nor schedule")
    return BoundedController(network, manifest.limits(), signal)


def _runner_files() -> dict[str, bytes]:
    return {f"controller/{path.name}": path.read_bytes() for path in _RUNTIME.glob("*.py")}


def _whole(manifest: BundleManifest, files: dict[str, bytes], sheet: str) -> bytes:
    """Pack all files into a ZIP with their manifest."""
    return pack_whole(manifest, files | {SHEET: sheet.encode()})


def pack_whole(manifest: BundleManifest, files: dict[str, bytes]) -> bytes:
    """Pack files into a ZIP with a manifest that names them."""
    full = replace(manifest, files={name: hashlib.sha256(content).hexdigest() for name, content in files.items()})
    return _pack(files | {MANIFEST: full.to_bytes()})


def describe(policy_onnx: bytes, manifest: BundleManifest, test_windows: NDArray[Any]) -> BundleManifest:
    """Describe the bundle by the manifest that `build_bundle` would write, all but the files; arguments and errors as there."""
    return _complete(policy_onnx, manifest, test_windows)[0]


def _complete(
    policy_onnx: bytes, manifest: BundleManifest, test_windows: NDArray[Any]
) -> tuple[BundleManifest, MlpNetwork | None, OnnxPolicy, NDArray[np.float64]]:
    """Complete the manifest from the network. Also return its layers where it is a plain one, the policy, and test windows with the
    edges."""
    usual = np.asarray(test_windows, dtype=np.float64)
    if usual.ndim != 2 or usual.shape[1] != manifest.window or len(usual) == 0 or not np.isfinite(usual).all():
        raise BundleError(f"test windows must be finite and of shape [M, {manifest.window}], M at least 1, not {list(usual.shape)}")
    policy = OnnxPolicy(policy_onnx, manifest.window, probe=usual)
    windows = vectors.edge_windows(usual)
    network, no_header = _plain(policy_onnx, windows, policy.act(windows), usual)
    manifest = replace(manifest, no_header=no_header, **appraisal.of(policy.act(usual), manifest))
    if network is None:
        return manifest, None, policy, windows
    manifest = replace(
        manifest,
        layers=(network.window, *(len(bias) for _, bias in network.layers)),
        activations=network.activations,
        normalisation_mean=network.mean,
        normalisation_std=network.std,
        **{f"output_{name}": value for name, value in network.output._asdict().items()},
    )
    fixed = quantise(network)
    if fixed is not None:
        manifest = replace(manifest, int8_bound=fixed.bound, int8_planes=fixed.planes, int8_bytes=fixed.size_bytes)
    return manifest, network, policy, windows


def _plain(
    policy_onnx: bytes, windows: NDArray[np.float64], expected: NDArray[np.float64], usual: NDArray[np.float64]
) -> tuple[MlpNetwork | None, str | None]:
    """Read the network as layers, if the file is a plain one; else return the reason. Its layers must give the file's own answers in numpy
    and with the header's tanh."""
    try:
        network = mlp_of(policy_onnx, usual)
    except (NoPlainNetwork, ValueError) as error:
        return None, f"the ONNX file is no plain multi-layer perceptron: {error}"
    worst = max(float(np.max(np.abs(answers - expected))) for answers in (network.act(windows), network.act(windows, header_tanh)))
    if not worst <= vectors.TOLERANCE:
        return None, f"its layers in float32 answer up to {worst:.2g} away from the ONNX file"
    return network, None


def verify_bundle(content: bytes, public_key: Ed25519PublicKey | None = None) -> BundleManifest:
    """Check a bundle as the tablet must before it stimulates; see `open_bundle`.

    Returns:
        The manifest.
    """
    return open_bundle(content, public_key).manifest


def open_bundle(content: bytes, public_key: Ed25519PublicKey | None = None) -> OpenBundle:
    """Check a bundle and load its network.

    Every file is named in the manifest and has its SHA-256, and nothing else is inside. ONNX file and reference runner reproduce the test
    vectors' fractions and decisions within 1e-5. With a public key, the manifest must be signed by it.

    Raises:
        BundleError: whatever is not as it should be; the message names it.
    """
    files = unpack(content)
    signature = files.pop(SIGNATURE, None)
    raw = files.pop(MANIFEST, None)
    if raw is None:
        raise BundleError(f"the bundle lacks {MANIFEST}")
    if public_key is not None:
        _check_signature(raw, signature, public_key)
    manifest = BundleManifest.from_bytes(raw)
    _check_names(manifest, set(files))
    for name, digest in manifest.files.items():
        found = hashlib.sha256(files[name]).hexdigest()
        if found != digest:
            raise BundleError(f"{name} is not the file that the manifest names: SHA-256 {found[:12]}... instead of {digest[:12]}...")
    digest = hashlib.sha256(raw).hexdigest()
    if manifest.sealed is not None:
        manifest, raw, files = _open_sealed(manifest, files[SEALED], manifest.sealed)
    return _load(manifest, raw, files, digest)


def _open_sealed(outer: BundleManifest, sealed: bytes, nonce: str) -> tuple[BundleManifest, bytes, dict[str, bytes]]:
    """Open the sealed manifest and files of a blinded bundle."""
    try:
        files = unseal(sealed, nonce)
        raw = files.pop(MANIFEST)
        inner = BundleManifest.from_bytes(raw)
        same_session(json.loads(outer.to_bytes()), json.loads(raw))
    except (ValueError, KeyError) as error:
        raise BundleError(f"{SEALED} cannot be used: {error}") from error
    if VECTORS not in files or (inner.schedule is None and not files.keys() & {WEIGHTS, MODEL}):
        raise BundleError(f"{SEALED} lacks {VECTORS} or the network")
    return inner, raw, files


def _load(manifest: BundleManifest, raw: bytes, files: dict[str, bytes], digest: str) -> OpenBundle:
    """Load the network of a bundle, and check it with the test vectors. `raw`: of the manifest. `digest`: by which logs name the bundle."""
    if manifest.schedule is not None:
        _check_decisions(raw, None, files[VECTORS], "the schedule")
        return OpenBundle(manifest, None, digest)
    if MODEL in files:
        policy = _check_vectors(files[MODEL], files[VECTORS], manifest.window)
        if WEIGHTS not in files:
            return OpenBundle(manifest, PolicyWindow(policy, manifest.window), digest)
    mean, std = manifest.normalisation_mean, manifest.normalisation_std
    if mean is None or std is None:
        raise BundleError(f"the manifest must state the normalisation of {WEIGHTS}")
    try:
        made = [
            MlpNetwork.from_bytes(files[WEIGHTS], manifest.layers, mean, std, manifest.activations, manifest.output()) for _ in range(2)
        ]
    except ValueError as error:
        raise BundleError(f"{WEIGHTS} cannot be used: {error}") from error
    _check_decisions(raw, made[0], files[VECTORS], WEIGHTS)  # which moves its window
    return OpenBundle(manifest, made[1], digest)


def _check_decisions(raw: bytes, network: MlpNetwork | None, stated: bytes, what: str) -> None:
    """Raise BundleError where the reference runner's own check of the test vectors fails."""
    try:
        check(json.loads(raw), network, json.loads(stated))
    except (ValueError, KeyError, TypeError) as error:
        raise BundleError(f"{what} does not agree with {VECTORS}: {error}") from error


def _check_names(manifest: BundleManifest, present: set[str]) -> None:
    """Check that the files named, and those inside, are one of the four sets that a bundle can be."""
    named = set(manifest.files)
    if manifest.sealed is not None:
        _compare_names(named, {SHEET, SEALED, *RUNNER}, present)
        return
    wanted = _REQUIRED | ({MODEL} if manifest.schedule is None else set())
    wanted |= (_OF_NETWORKS if manifest.layers else set()) | (_OF_SMALL_NETWORKS if manifest.int8_bound is not None else set())
    if manifest.layers or manifest.schedule:
        wanted |= set(RUNNER)
    if manifest.schedule is None:
        wanted |= named & _OF_PORTS
    _compare_names(named, wanted, present)


def _compare_names(named: set[str], wanted: set[str], present: set[str]) -> None:
    if named != wanted:
        raise BundleError(f"the manifest must name {', '.join(sorted(wanted))}; it names {', '.join(sorted(named)) or 'nothing'}")
    for name in sorted(present ^ named):
        raise BundleError(f"the bundle lacks {name}" if name in named else f"the bundle holds {name}, which the manifest does not name")


def sign(content: bytes, private_key: Ed25519PrivateKey) -> bytes:
    """Sign the manifest of a bundle, which by its hashes covers every file; an older signature is replaced.

    Raises:
        BundleError: the bundle is not intact, or names another key.
    """
    named = verify_bundle(content).public_key
    if named is not None and named != private_key.public_key().public_bytes_raw().hex():
        raise BundleError("the manifest names another key than the one to sign with")
    files = unpack(content)
    return _pack(files | {SIGNATURE: private_key.sign(files[MANIFEST])})


def _check_signature(manifest: bytes, signature: bytes | None, public_key: Ed25519PublicKey) -> None:
    if signature is None:
        raise BundleError("the bundle is not signed")
    try:
        public_key.verify(signature, manifest)
    except InvalidSignature as error:
        raise BundleError("the signature of the manifest does not belong to this public key, or the manifest was changed") from error


def _check_vectors(model: bytes, raw: bytes, window: int) -> OnnxPolicy:
    try:
        stated = json.loads(raw)
        windows = np.array(stated["windows"], dtype=np.float64)
        expected = np.array(stated["expected"], dtype=np.float64)
    except (ValueError, KeyError, TypeError) as error:
        raise BundleError(f"{VECTORS} cannot be read: {error}") from error
    if expected.ndim != 1 or expected.size == 0 or windows.shape != (expected.size, window):
        raise BundleError(f"{VECTORS} holds windows {list(windows.shape)} and answers {list(expected.shape)}; the window is {window}")
    try:
        policy = OnnxPolicy(model, window)
        answers = policy.act(windows)
    except (PolicyFileError, PolicyOutputError) as error:
        raise BundleError(f"{MODEL} cannot be run: {error}") from error
    difference = np.abs(answers - expected)
    if not np.all(difference <= vectors.TOLERANCE):  # False for NaN as well
        row = int(np.argmax(np.nan_to_num(difference, nan=np.inf)))
        raise BundleError(f"the network answers {answers[row]:.6f} to test vector {row}; the bundle says {expected[row]:.6f}")
    return policy


def _pack(files: dict[str, bytes]) -> bytes:
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
        for name in _ORDER:
            if name in files:
                entry = zipfile.ZipInfo(name, _EPOCH)
                entry.create_system = 3  # the same on every operating system
                entry.external_attr = 0o644 << 16
                archive.writestr(entry, files[name])
    return sink.getvalue()


def unpack(content: bytes) -> dict[str, bytes]:
    """Unpack the files of a bundle. Raises BundleError for other bytes."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
            names = [entry.filename for entry in entries]
            if len(set(names)) != len(names):
                raise BundleError("the bundle holds two files of one name")
            too_large = [entry.filename for entry in entries if entry.file_size > MAX_FILE_BYTES]
            if too_large or len(entries) > 32:
                raise BundleError(f"this is no controller bundle: {len(entries)} files, too large: {', '.join(too_large) or 'none'}")
            return {entry.filename: archive.read(entry) for entry in entries}
    except (zipfile.BadZipFile, EOFError, RuntimeError, OSError, ValueError) as error:
        if isinstance(error, BundleError):
            raise
        raise BundleError(f"this is no intact ZIP file: {error}") from error
