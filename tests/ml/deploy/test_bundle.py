from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import zipfile

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given, settings
from hypothesis import strategies as st

from ml.deploy.bundle import build_bundle, model_of, sign, verify_bundle
from ml.deploy.envelope import EnvelopeLimits
from ml.deploy.manifest import BundleError, BundleManifest
from ml.rl.networks import MlpPolicy
from ml.rl.onnx_policy import PolicyFileError


@pytest.fixture(scope="module")
def bundle(network, manifest, test_windows):
    return build_bundle(network.to_onnx(), manifest, test_windows)


def unpack(content):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def pack(files):
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return sink.getvalue()


def with_file(bundle, name, content, *, restate=False):
    """The bundle with one file changed; `restate` writes the new SHA-256 into the manifest, as a careful forger would."""
    files = unpack(bundle) | {name: content}
    if restate:
        stated = json.loads(files["manifest.json"])
        stated["files"][name] = hashlib.sha256(content).hexdigest()
        files["manifest.json"] = json.dumps(stated).encode()
    return pack(files)


def test_a_bundle_holds_the_network_its_vectors_the_sheet_and_every_hash(bundle, network, manifest, test_windows):
    files = unpack(bundle)
    assert set(files) == {"model.onnx", "test_vectors.json", "README.txt", "manifest.json"}
    assert files["model.onnx"] == network.to_onnx() == model_of(bundle)
    stated = verify_bundle(bundle)
    assert dataclasses.replace(stated, files={}) == manifest
    assert stated.files == {name: hashlib.sha256(content).hexdigest() for name, content in files.items() if name != "manifest.json"}
    vectors = json.loads(files["test_vectors.json"])
    np.testing.assert_array_equal(vectors["windows"], test_windows)
    np.testing.assert_allclose(vectors["expected"], network.act(test_windows), atol=1e-5)


def test_the_same_arguments_give_the_same_bytes(bundle, network, manifest, test_windows):
    assert build_bundle(network.to_onnx(), manifest, test_windows) == bundle
    assert build_bundle(network.to_onnx(), dataclasses.replace(manifest, policy_id=42), test_windows) != bundle


def test_the_sheet_fits_one_page_and_says_what_matters(bundle, network):
    sheet = unpack(bundle)["README.txt"].decode()
    lines = sheet.splitlines()
    assert len(lines) <= 60
    assert max(map(len, lines)) <= 82
    for fact in (
        "P-07",
        "uV",
        "time_domain",
        "3 mA",
        "0.5 to 3.2 mA",
        "0.25 mA/s",
        "A. Clinician",
        hashlib.sha256(network.to_onnx()).hexdigest(),
    ):
        assert fact in sheet


def test_a_sheet_without_approval_forbids_its_use(network, manifest, test_windows):
    bare = build_bundle(network.to_onnx(), dataclasses.replace(manifest, approvals=()), test_windows)
    assert "not to be used on a participant" in unpack(bare)["README.txt"].decode()


def test_the_manifests_limits_are_the_envelopes(manifest):
    assert manifest.limits() == EnvelopeLimits(min_ma=0.5, max_ma=3.2, cdbs_ma=3.0, ramp_ma_per_s=0.25, window=10, period_s=2.0)


@pytest.mark.parametrize("name", ["model.onnx", "test_vectors.json", "README.txt"])
def test_a_changed_file_is_named(bundle, name):
    changed = unpack(bundle)[name] + b" "
    with pytest.raises(BundleError, match=f"{name} is not the file"):
        verify_bundle(with_file(bundle, name, changed))


def test_another_network_fails_the_test_vectors_even_where_its_hash_is_restated(bundle):
    with pytest.raises(BundleError, match=r"the network answers .* to test vector"):
        verify_bundle(with_file(bundle, "model.onnx", MlpPolicy(10, (20, 10), seed=8).to_onnx(), restate=True))


def test_changed_expectations_fail_even_where_their_hash_is_restated(bundle):
    vectors = json.loads(unpack(bundle)["test_vectors.json"])
    vectors["expected"][5] += 2e-5
    with pytest.raises(BundleError, match="test vector 5"):
        verify_bundle(with_file(bundle, "test_vectors.json", json.dumps(vectors).encode(), restate=True))
    vectors["expected"][5] = float("nan")
    with pytest.raises(BundleError, match="test vector 5"):
        verify_bundle(with_file(bundle, "test_vectors.json", json.dumps(vectors).encode(), restate=True))
    with pytest.raises(BundleError, match=r"test_vectors\.json"):
        verify_bundle(with_file(bundle, "test_vectors.json", b'{"windows": [], "expected": []}', restate=True))


def test_a_file_too_many_or_too_few_is_named(bundle):
    with pytest.raises(BundleError, match=r"notes\.txt, which the manifest does not name"):
        verify_bundle(pack(unpack(bundle) | {"notes.txt": b"hello"}))
    for name in ("model.onnx", "manifest.json"):
        with pytest.raises(BundleError, match=f"lacks {name}"):
            verify_bundle(pack({k: v for k, v in unpack(bundle).items() if k != name}))


@settings(max_examples=60, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_no_changed_byte_of_the_contents_goes_unnoticed(bundle, place, flip):
    files = unpack(bundle)
    at = int(place * sum(len(content) for content in files.values()))
    names = iter(files)
    while at >= len(files[name := next(names)]):
        at -= len(files[name])
    content = files[name]
    changed = content[:at] + bytes([content[at] ^ flip]) + content[at + 1 :]
    damaged = pack(files | {name: changed})
    try:
        stated = verify_bundle(damaged)
    except BundleError:
        return
    # Only the manifest, which no hash covers, can differ and still be read; a signature is for that.
    assert name == "manifest.json"
    assert stated.to_bytes() != verify_bundle(bundle).to_bytes() or json.loads(changed) == json.loads(content)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=300))
def test_anything_else_is_no_bundle(content):
    with pytest.raises(BundleError):
        verify_bundle(content)


def test_a_truncated_bundle_is_no_bundle(bundle):
    with pytest.raises(BundleError, match="no intact ZIP"):
        verify_bundle(bundle[: len(bundle) // 2])


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_files_of_one_name_are_refused(bundle):
    sink = io.BytesIO(bundle)
    with zipfile.ZipFile(sink, "a") as archive:
        archive.writestr("model.onnx", b"another")
    with pytest.raises(BundleError, match="two files of one name"):
        verify_bundle(sink.getvalue())


def test_a_signed_bundle_is_accepted_with_its_key_and_no_other(bundle):
    key, other = Ed25519PrivateKey.generate(), Ed25519PrivateKey.generate()
    signed = sign(bundle, key)
    assert verify_bundle(signed, key.public_key()) == verify_bundle(signed) == verify_bundle(bundle)
    with pytest.raises(BundleError, match="does not belong to this public key"):
        verify_bundle(signed, other.public_key())
    with pytest.raises(BundleError, match="not signed"):
        verify_bundle(bundle, key.public_key())
    assert verify_bundle(sign(signed, other), other.public_key()).policy_id == 41


def test_a_signature_covers_the_limits(bundle):
    key = Ed25519PrivateKey.generate()
    files = unpack(sign(bundle, key))
    stated = json.loads(files["manifest.json"]) | {"max_ma": 5.0}
    forged = pack(files | {"manifest.json": json.dumps(stated).encode()})
    assert verify_bundle(forged).max_ma == 5.0, "without a key nobody can tell"
    with pytest.raises(BundleError, match="manifest was changed"):
        verify_bundle(forged, key.public_key())


def test_a_damaged_bundle_is_not_signed(bundle):
    with pytest.raises(BundleError, match=r"README\.txt"):
        sign(with_file(bundle, "README.txt", b"x"), Ed25519PrivateKey.generate())


def test_a_policy_of_another_window_or_none_is_not_packed(manifest, test_windows):
    with pytest.raises(PolicyFileError, match="windows of 12"):
        build_bundle(MlpPolicy(12, (4,)).to_onnx(), manifest, test_windows)
    with pytest.raises(PolicyFileError, match="not an ONNX file"):
        build_bundle(b"nonsense", manifest, test_windows)


@pytest.mark.parametrize("windows", [np.zeros((0, 10)), np.zeros((3, 9)), np.full((2, 10), np.nan), np.zeros(10)])
def test_test_windows_must_be_usable(network, manifest, windows):
    with pytest.raises(BundleError, match="test windows"):
        build_bundle(network.to_onnx(), manifest, windows)


def test_a_manifest_goes_through_json(manifest):
    assert BundleManifest.from_bytes(manifest.to_bytes()) == manifest


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cdbs_ma": 9.0}, "cDBS amplitude 9"),
        ({"min_ma": -1.0}, "rise from 0"),
        ({"ramp_ma_per_s": 0.0}, "ramp_ma_per_s must be positive"),
        ({"window": "ten"}, "window in manifest.json must be int"),
        ({"window": True}, "window in manifest.json must be int"),
        ({"participant": " "}, "needs a participant"),
        ({"snapshot_sha256": "abc"}, "64 hexadecimal digits"),
        ({"normalisation_std": None}, "normalisation needs"),
        ({"schema_version": 99}, "manifest version 99"),
        ({"colour": "red"}, "unknown entries: colour"),
        ({"files": {"model.onnx": 3}}, "files in manifest.json must map"),
        ({"approvals": [{"name": "A"}]}, "lacks approved_at, role, statement"),
        ({"approvals": "all"}, "list of objects"),
    ],
)
def test_a_manifest_that_cannot_be_right_is_refused_by_name(manifest, change, message):
    values = json.loads(manifest.to_bytes()) | change
    with pytest.raises(BundleError, match=message):
        BundleManifest.from_bytes(json.dumps(values).encode())


def test_a_manifest_without_a_limit_is_refused(manifest):
    values = json.loads(manifest.to_bytes())
    del values["max_ma"]
    with pytest.raises(BundleError, match="lacks max_ma"):
        BundleManifest.from_bytes(json.dumps(values).encode())
