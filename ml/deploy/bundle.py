"""The controller bundle: one ZIP that carries a policy from the study to the tablet, and proves that it arrived whole.

    model.onnx         the network: beta_window [N, W] to amplitude_fraction [N, 1]
    test_vectors.json  beta windows and the fractions that every runtime must give for them
    README.txt         the one-page sheet
    manifest.json      whose, for which signal, within which limits; SHA-256 of each file above
    manifest.sig       Ed25519 signature of manifest.json, where the bundle is signed

The bytes of a bundle depend on its contents alone: no times, fixed order, no compression (its output differs between zlib versions).
"""

from __future__ import annotations

import hashlib
import io
import json
import textwrap
import zipfile
from dataclasses import replace
from typing import Any

import numpy as np
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from numpy.typing import NDArray

from ml.deploy.manifest import BundleError, BundleManifest
from ml.rl.onnx_policy import MAX_FILE_BYTES, OnnxPolicy, PolicyFileError, PolicyOutputError

MODEL, VECTORS, SHEET, MANIFEST, SIGNATURE = "model.onnx", "test_vectors.json", "README.txt", "manifest.json", "manifest.sig"
VECTOR_TOLERANCE = 1e-5
"""Largest difference between two runtimes on a test vector, amplitude fraction."""
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time a ZIP can hold


def build_bundle(policy_onnx: bytes, manifest: BundleManifest, test_windows: NDArray[Any]) -> bytes:
    """Pack a policy for the tablet.

    Args:
        policy_onnx: the network.
        manifest: everything but `files`, which is filled in here.
        test_windows: beta windows for the test vectors, shape [M, W], M at least 1, finite.

    Returns:
        The ZIP's bytes, the same for the same arguments.

    Raises:
        PolicyFileError: the network is no policy of this window.
        BundleError: test windows of another shape, or not finite.
    """
    windows = np.asarray(test_windows, dtype=np.float64)
    if windows.ndim != 2 or windows.shape[1] != manifest.window or len(windows) == 0 or not np.isfinite(windows).all():
        raise BundleError(f"test windows must be finite and of shape [M, {manifest.window}], M at least 1, not {list(windows.shape)}")
    policy = OnnxPolicy(policy_onnx, manifest.window, probe=windows)
    vectors = {"tolerance": VECTOR_TOLERANCE, "windows": windows.tolist(), "expected": policy.act(windows).tolist()}
    files = {
        MODEL: policy_onnx,
        VECTORS: (json.dumps(vectors, allow_nan=False) + "\n").encode(),
        SHEET: _sheet(manifest, policy_onnx).encode(),
    }
    full = replace(manifest, files={name: hashlib.sha256(content).hexdigest() for name, content in files.items()})
    return _pack(files | {MANIFEST: full.to_bytes()})


def verify_bundle(content: bytes, public_key: Ed25519PublicKey | None = None) -> BundleManifest:
    """Check a bundle as the tablet must before it stimulates.

    Every file is named in the manifest and has its SHA-256, nothing else is inside, the network gives the test vectors' fractions again
    within 1e-5 and, with a public key, the manifest is signed by it.

    Returns:
        The manifest.

    Raises:
        BundleError: whatever is not as it should be; the message names it.
    """
    files = _unpack(content)
    signature = files.pop(SIGNATURE, None)
    raw = files.pop(MANIFEST, None)
    if raw is None:
        raise BundleError(f"the bundle lacks {MANIFEST}")
    if public_key is not None:
        _check_signature(raw, signature, public_key)
    manifest = BundleManifest.from_bytes(raw)
    if set(manifest.files) != {MODEL, VECTORS, SHEET}:
        raise BundleError(
            f"the manifest must name {MODEL}, {VECTORS} and {SHEET}; it names {', '.join(sorted(manifest.files)) or 'nothing'}"
        )
    for name in sorted(set(files) ^ set(manifest.files)):
        raise BundleError(
            f"the bundle lacks {name}" if name in manifest.files else f"the bundle holds {name}, which the manifest does not name"
        )
    for name, digest in manifest.files.items():
        found = hashlib.sha256(files[name]).hexdigest()
        if found != digest:
            raise BundleError(f"{name} is not the file that the manifest names: SHA-256 {found[:12]}... instead of {digest[:12]}...")
    _check_vectors(files[MODEL], files[VECTORS], manifest.window)
    return manifest


def sign(content: bytes, private_key: Ed25519PrivateKey) -> bytes:
    """The bundle with a signature of its manifest, which by its hashes covers every file; an older signature is replaced.

    Raises:
        BundleError: the bundle is not intact.
    """
    verify_bundle(content)
    files = _unpack(content)
    return _pack(files | {SIGNATURE: private_key.sign(files[MANIFEST])})


def model_of(content: bytes) -> bytes:
    """The ONNX file of a bundle. Raises BundleError when there is none."""
    files = _unpack(content)
    if MODEL not in files:
        raise BundleError(f"the bundle lacks {MODEL}")
    return files[MODEL]


def _check_signature(manifest: bytes, signature: bytes | None, public_key: Ed25519PublicKey) -> None:
    if signature is None:
        raise BundleError("the bundle is not signed")
    try:
        public_key.verify(signature, manifest)
    except InvalidSignature as error:
        raise BundleError("the signature of the manifest does not belong to this public key, or the manifest was changed") from error


def _check_vectors(model: bytes, raw: bytes, window: int) -> None:
    try:
        vectors = json.loads(raw)
        windows = np.array(vectors["windows"], dtype=np.float64)
        expected = np.array(vectors["expected"], dtype=np.float64)
    except (ValueError, KeyError, TypeError) as error:
        raise BundleError(f"{VECTORS} cannot be read: {error}") from error
    if expected.ndim != 1 or expected.size == 0 or windows.shape != (expected.size, window):
        raise BundleError(f"{VECTORS} holds windows {list(windows.shape)} and answers {list(expected.shape)}; the window is {window}")
    try:
        answers = OnnxPolicy(model, window).act(windows)
    except (PolicyFileError, PolicyOutputError) as error:
        raise BundleError(f"{MODEL} cannot be run: {error}") from error
    difference = np.abs(answers - expected)
    if not np.all(difference <= VECTOR_TOLERANCE):  # False for NaN as well
        row = int(np.argmax(np.nan_to_num(difference, nan=np.inf)))
        raise BundleError(f"the network answers {answers[row]:.6f} to test vector {row}; the bundle says {expected[row]:.6f}")


def _pack(files: dict[str, bytes]) -> bytes:
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
        for name in (MANIFEST, SIGNATURE, SHEET, MODEL, VECTORS):
            if name in files:
                entry = zipfile.ZipInfo(name, _EPOCH)
                entry.create_system = 3  # the same on every operating system
                entry.external_attr = 0o644 << 16
                archive.writestr(entry, files[name])
    return sink.getvalue()


def _unpack(content: bytes) -> dict[str, bytes]:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
            names = [entry.filename for entry in entries]
            if len(set(names)) != len(names):
                raise BundleError("the bundle holds two files of one name")
            too_large = [entry.filename for entry in entries if entry.file_size > MAX_FILE_BYTES]
            if too_large or len(entries) > 16:
                raise BundleError(f"this is no controller bundle: {len(entries)} files, too large: {', '.join(too_large) or 'none'}")
            return {entry.filename: archive.read(entry) for entry in entries}
    except (zipfile.BadZipFile, EOFError, RuntimeError, OSError, ValueError) as error:
        if isinstance(error, BundleError):
            raise
        raise BundleError(f"this is no intact ZIP file: {error}") from error


def _sheet(manifest: BundleManifest, model: bytes) -> str:
    """The one-page sheet, 82 characters wide."""
    limits = manifest.limits()
    age = limits.period_s if limits.max_beta_age_s is None else limits.max_beta_age_s
    back = "at once" if limits.fallback_ramp_ma_per_s is None else f"at {limits.fallback_ramp_ma_per_s:g} mA/s"
    scale = "inside the network"
    if manifest.normalisation_mean is not None:
        scale += f" (mean {manifest.normalisation_mean:.6g}, sd {manifest.normalisation_std:.6g})"
    approvals = [f"  {a.name} ({a.role}), {a.approved_at}: {a.statement}" for a in manifest.approvals] or [
        "  none: not to be used on a participant"
    ]
    lines = [
        "CONTROLLER BUNDLE",
        "=================",
        f"Participant       {manifest.participant}",
        f"Policy            {manifest.policy_name} (no. {manifest.policy_id})",
        f"Model SHA-256     {hashlib.sha256(model).hexdigest()}",
        f"Snapshot SHA-256  {manifest.snapshot_sha256 or 'none: trained outside this study'}",
        f"Made by           betaloop {manifest.code_version}",
        "",
        "SIGNAL",
        f"Every {manifest.period_s:g} s the newest {manifest.window} beta amplitudes, oldest first,",
        f"in {manifest.beta_unit}, from {manifest.beta_source}. Scaling: {scale}.",
        "",
        "STIMULATION",
        f"Fraction 1 is the cDBS amplitude, {manifest.cdbs_ma:g} mA.",
        f"Limits            {manifest.min_ma:g} to {manifest.max_ma:g} mA",
        f"Ramp              {manifest.ramp_ma_per_s:g} mA/s, {manifest.ramp_ma_per_s * manifest.period_s:g} mA per period",
        f"If beta is missing, not a number, older than {age:g} s or not yet a whole",
        f"window, or the network fails: cDBS amplitude, {back}, in that very period.",
        "",
        "BEFORE USE",
        "Check the bundle (`betaloop` verifies every SHA-256, the signature where",
        "there is one, and the test vectors). Use it for this participant only.",
        "",
        "APPROVALS",
        *approvals,
        "",
    ]
    return "\n".join(wrapped for line in lines for wrapped in textwrap.wrap(line, 82, subsequent_indent="    ") or [""])
