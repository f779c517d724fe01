from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import re
import shutil
import subprocess
import zipfile

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given, settings
from hypothesis import strategies as st
from pypdf import PdfReader

from ml.deploy.bundle import RUNNER, build_bundle, open_bundle, sign, verify_bundle
from ml.deploy.manifest import BundleError, BundleManifest
from ml.deploy.runtime.envelope import BetaSample, EnvelopeLimits, Signal
from ml.policies.onnx_policy import PolicyFileError
from ml.rl import MlpPolicy


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
    """Change one file of the bundle; `restate` writes the new SHA-256 into the manifest, as a careful forger would."""
    files = unpack(bundle) | {name: content}
    if restate:
        stated = json.loads(files["manifest.json"])
        stated["files"][name] = hashlib.sha256(content).hexdigest()
        files["manifest.json"] = json.dumps(stated).encode()
    return pack(files)


NETWORK_FILES = {"sheet.html", "model.onnx", "test_vectors.json", "weights.f32", "betaloop_controller.h", "selftest.c", *RUNNER}
SMALL_FILES = {"betaloop_controller_int8.h", "selftest_int8.c"}
PORT_FILES = {"port-vectors.csv", "model-lost-sample.onnx"}


def test_a_bundle_holds_the_network_in_every_form_its_vectors_the_sheet_and_every_hash(bundle, network, manifest, test_windows):
    files = unpack(bundle)
    assert set(files) == NETWORK_FILES | SMALL_FILES | PORT_FILES | {"manifest.json"}
    assert files["model.onnx"] == network.to_onnx()
    stated = verify_bundle(bundle)
    assert stated.files == {name: hashlib.sha256(content).hexdigest() for name, content in files.items() if name != "manifest.json"}
    assert (stated.layers, stated.parameters, stated.macs) == ((10, 20, 10, 1), network.parameter_count, network.macs)
    filled = {"files": {}, "layers": (), "activations": (), "test_windows": 0, "int8_bound": None, "int8_planes": None, "int8_bytes": None}
    assert dataclasses.replace(stated, **filled) == manifest
    vectors = json.loads(files["test_vectors.json"])
    np.testing.assert_array_equal(vectors["windows"][: len(test_windows)], test_windows)
    np.testing.assert_allclose(vectors["expected"], network.act(np.array(vectors["windows"])), atol=1e-5)


def test_a_bundle_without_a_part_of_its_runner_or_network_is_refused(network, manifest, test_windows):
    made = build_bundle(network.to_onnx(), manifest, test_windows)
    for missing in ("controller/control_loop.py", "weights.f32"):
        files = unpack(made)
        stated = json.loads(files["manifest.json"])
        del files[missing], stated["files"][missing]
        with pytest.raises(BundleError, match=rf"the manifest must name .*{missing}"):
            open_bundle(pack(files | {"manifest.json": json.dumps(stated).encode()}))


def test_the_test_vectors_reach_saturation_and_every_way_in_which_beta_goes_wrong(bundle):
    vectors = json.loads(unpack(bundle)["test_vectors.json"])
    assert min(vectors["expected"]) < 1e-3 or max(vectors["expected"]) > 1 - 1e-3
    met = {reason for step in vectors["session"] for reason in step["reasons"]}
    assert met >= {
        "no_beta",
        "stale_beta",
        "invalid_beta",
        "wrong_signal",
        "window_incomplete",
        "window_gap",
        "late_sample",
        "minimum",
        "ramp",
    }
    assert any(step["t_s"] is None for step in vectors["session"])
    assert any(step["t_s"] is not None and step["beta"] is None for step in vectors["session"])


def test_a_policy_without_layers_leaves_as_onnx_alone_and_runs_within_the_same_envelope(manifest, test_windows):
    from app.learning.policies import constant_onnx

    made = build_bundle(
        constant_onnx(0.5, 10), dataclasses.replace(manifest, normalisation_mean=None, normalisation_std=None), test_windows
    )
    assert set(unpack(made)) == {"sheet.html", "model.onnx", "test_vectors.json", "manifest.json"} | PORT_FILES
    opened = open_bundle(made)
    controller, signal = opened.controller(), Signal("uV", "time_domain")
    amplitudes = [controller.decide(2.0 * k, BetaSample(2.0 * k, 120.0 + k % 2, signal)).amplitude_ma for k in range(20)]
    assert amplitudes[8] == 3.0
    assert amplitudes[9:13] == pytest.approx([2.5, 2.0, 1.5, 1.5])


def test_the_same_arguments_give_the_same_bytes(bundle, network, manifest, test_windows):
    assert build_bundle(network.to_onnx(), manifest, test_windows) == bundle
    assert build_bundle(network.to_onnx(), dataclasses.replace(manifest, policy_id=42), test_windows) != bundle


def test_the_sheet_says_what_matters(bundle, network):
    sheet = unpack(bundle)["sheet.html"].decode()
    facts = (
        "P-07", "left hemisphere", "uV, from time_domain", "3 mA", "0.5 mA", "3.2 mA", "0.25 mA/s", "A. Clinician", "0 to 3.4 mA",
        "ada@clinic.example", "10 → 20 → 10 → 1", "441 weights", "410 multiply-adds", "teacher rl-03", "0.0012", "fraction within",
        hashlib.sha256(network.to_onnx()).hexdigest(),
    )  # fmt: skip
    for fact in facts:
        assert fact in sheet, fact
    assert "NOT APPROVED" not in sheet.upper()


def test_a_sheet_without_approval_forbids_its_use(network, manifest, test_windows):
    bare = unpack(build_bundle(network.to_onnx(), dataclasses.replace(manifest, approvals=()), test_windows))
    assert "not to be used on a participant" in bare["sheet.html"].decode()
    assert "NOT APPROVED" in bare["betaloop_controller.h"].decode()


@pytest.mark.browser
def test_the_sheet_prints_on_one_page_even_with_long_names(network, manifest, test_windows, tmp_path):
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("needs Chromium")
    approval = dataclasses.replace(manifest.approvals[0], statement="plan 12 of visit 7")
    long = dataclasses.replace(
        manifest, policy_name="fine-tuned after visit 3, seed 2, distilled " * 2, approvals=(approval, approval),
        test_windows_from="snapshot 4", logged_lower_bound=0.9, min_ma=2.9, public_key="cd" * 32,
    )  # with both warnings  # fmt: skip
    (tmp_path / "sheet.html").write_bytes(unpack(build_bundle(network.to_onnx(), long, test_windows))["sheet.html"])
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--no-pdf-header-footer", f"--user-data-dir={tmp_path / 'profile'}"]
    printed = [chromium, *options, f"--print-to-pdf={tmp_path / 'sheet.pdf'}", (tmp_path / "sheet.html").as_uri()]
    subprocess.run(printed, check=True, capture_output=True, timeout=120)
    pages = PdfReader(tmp_path / "sheet.pdf").pages
    assert len(pages) == 1
    text = pages[0].extract_text()
    assert "P-07" in text
    assert text.count("recorded windows") == 3
    assert "no medical device" in text


def test_no_name_can_leave_its_place_in_the_sheet(network, manifest, test_windows):
    bad = "<script>alert(1)</script>&\"'"
    changed = dataclasses.replace(manifest, participant=bad, policy_name=bad, beta_unit=bad, teacher_name=bad, limits_stated_by=bad)
    sheet = unpack(build_bundle(network.to_onnx(), changed, test_windows))["sheet.html"].decode()
    assert "<script" not in sheet
    assert sheet.count("&lt;script&gt;") >= 4


def test_the_manifests_limits_are_the_envelopes(manifest):
    assert manifest.limits() == EnvelopeLimits(
        min_ma=0.5, max_ma=3.2, cdbs_ma=3.0, ramp_ma_per_s=0.25, window=10, period_s=2.0, beta_max=900.0, level_low=30.0, level_high=400.0,
        frozen_after=5, most_imputed=2, carried_over=0.7,
    )  # fmt: skip


@pytest.mark.parametrize("name", sorted(NETWORK_FILES | SMALL_FILES))
def test_a_changed_file_is_named(bundle, name):
    changed = unpack(bundle)[name] + b" "
    with pytest.raises(BundleError, match=f"{re.escape(name)} is not the file"):
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


@pytest.mark.parametrize(
    "change",
    [{"max_ma": 3.3}, {"participant": "P-08"}, {"approvals": []}, {"beta_unit": "mV"}, {"ramp_ma_per_s": 2.0}, {"hemisphere": "right"}],
)
def test_a_signature_covers_limits_approvals_participant_and_signal(bundle, change):
    key = Ed25519PrivateKey.generate()
    files = unpack(sign(bundle, key))
    stated = json.loads(files["manifest.json"]) | change
    forged = pack(files | {"manifest.json": json.dumps(stated).encode()})
    with pytest.raises(BundleError, match="manifest was changed"):
        verify_bundle(forged, key.public_key())


def test_an_approval_that_was_added_by_hand_does_not_pass(bundle, manifest):
    key = Ed25519PrivateKey.generate()
    files = unpack(sign(bundle, key))
    stated = json.loads(files["manifest.json"])
    stated["approvals"].append({"name": "M", "role": "clinician", "approved_at": "2026-03-02T09:00:00+00:00", "statement": "all"})
    forged = pack(files | {"manifest.json": json.dumps(stated).encode()})
    assert len(verify_bundle(forged).approvals) == 2, "without a key nobody can tell"
    with pytest.raises(BundleError, match="manifest was changed"):
        verify_bundle(forged, key.public_key())


@pytest.mark.parametrize("version", [3, 5])
def test_a_bundle_of_another_manifest_version_is_refused(bundle, version):
    files = unpack(bundle)
    stated = json.loads(files["manifest.json"]) | {"schema_version": version}
    with pytest.raises(BundleError, match=f"manifest version {version}; this betaloop reads version 4"):
        verify_bundle(pack(files | {"manifest.json": json.dumps(stated).encode()}))


def test_a_bundle_is_signed_with_the_key_that_it_names(network, manifest, test_windows):
    key = Ed25519PrivateKey.generate()
    named = dataclasses.replace(manifest, public_key=key.public_key().public_bytes_raw().hex())
    made = build_bundle(network.to_onnx(), named, test_windows)
    assert verify_bundle(sign(made, key), key.public_key()).public_key == named.public_key
    with pytest.raises(BundleError, match="another key"):
        sign(made, Ed25519PrivateKey.generate())


def test_other_weights_fail_the_test_vectors_even_where_their_hash_is_restated(bundle):
    weights = np.frombuffer(unpack(bundle)["weights.f32"], dtype="<f4").copy()
    weights[-1] += 0.01
    with pytest.raises(BundleError, match=r"weights\.f32 does not agree"):
        verify_bundle(with_file(bundle, "weights.f32", weights.tobytes(), restate=True))
    with pytest.raises(BundleError, match="do not fit layers"):
        verify_bundle(with_file(bundle, "weights.f32", weights[:-1].tobytes(), restate=True))


def test_a_damaged_bundle_is_not_signed(bundle):
    with pytest.raises(BundleError, match=r"sheet\.html"):
        sign(with_file(bundle, "sheet.html", b"x"), Ed25519PrivateKey.generate())


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
        ({"max_ma": 3.5}, "above the stimulator's own limit, 3.4 mA"),
        ({"min_ma": 0.1, "device_min_ma": 0.2}, "below the stimulator's own limit, 0.2 mA"),
        ({"hemisphere": "middle"}, "left or right"),
        ({"layers": [10, "20", 1]}, "list of whole numbers"),
        ({"layers": [9, 1]}, "from the window"),
        ({"max_beta_age_s": 2.0}, "stale before one period"),
        ({"beta_low_hz": 40.0}, "beta band"),
        ({"int8_planes": 1.5}, "int8_planes in manifest.json must be int"),
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
