"""Policies over REST and on their pages: those made elsewhere, baselines, bundles."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning.policies import constant_onnx, ensure_baselines, proportional_onnx
from app.learning.schemas import DistilParams
from app.learning.snapshots import collect, take_snapshot
from app.learning.training_configs import distillation_config
from app.platform import files
from app.study.repository import participant_by_code
from app.tables.learning import Policy
from ml.deploy.bundle import verify_bundle
from ml.policies.onnx_policy import OnnxPolicy
from ml.policies.policy import ConstantPolicy, ProportionalPolicy

Upload = Callable[..., int]
WINDOWS = np.abs(np.random.default_rng(1).normal(1.0, 0.6, (200, 10)))


def post_policy(client: TestClient, content: bytes, name: str = "from Lyon") -> object:
    return client.post("/api/v1/participants/P1/policies", data={"name": name}, files={"file": ("lyon.onnx", content, "application/onnx")})


@pytest.mark.parametrize("amplitude", [0.0, 0.37, 1.0])
def test_a_constant_baseline_answers_the_same_to_every_window(amplitude: float) -> None:
    answers = OnnxPolicy(constant_onnx(amplitude, 10), 10).act(WINDOWS)
    np.testing.assert_allclose(answers, ConstantPolicy(amplitude).act(WINDOWS), atol=1e-7)


@pytest.mark.parametrize(("floor", "newest"), [(0.0, 1), (0.2, 3)])
def test_the_proportional_file_is_the_proportional_policy(floor: float, newest: int) -> None:
    policy = ProportionalPolicy(0.6, 1.7, floor, newest)
    np.testing.assert_allclose(OnnxPolicy(proportional_onnx(policy, 10), 10).act(WINDOWS), policy.act(WINDOWS), atol=1e-6)


def test_baselines_are_made_once(upload: Upload, db: Session) -> None:
    upload("random")
    participant = participant_by_code(db, "P1", SYSTEM)
    snapshot = take_snapshot(db, participant, SYSTEM)
    buffer = collect(db, participant).buffer
    first = ensure_baselines(db, participant, snapshot, buffer, "test")
    again = ensure_baselines(db, participant, snapshot, buffer, "test")
    assert [p.id for p in first] == [p.id for p in again]
    assert [p.config["amplitude"] for p in first if p.algorithm == "constant"] == [1.0, 0.85, 0.7, 0.55, 0.4]
    (proportional,) = [p for p in first if p.algorithm == "proportional"]
    beta = np.concatenate([s.padded_beta for s in buffer.sessions])
    assert proportional.config["low"] == pytest.approx(float(np.nanquantile(beta, 0.25)))


def test_a_policy_made_elsewhere_is_stored_as_it_came(client: TestClient, participant_code: str) -> None:
    content = constant_onnx(0.6, 10)
    answer = post_policy(client, content)
    assert answer.status_code == 201
    body = answer.json()
    assert (body["name"], body["kind"], body["teacher_id"], body["retired_reason"]) == ("from Lyon", "external", None, None)
    assert files.read(body["onnx_sha256"]) == content
    assert client.get(f"/api/v1/policies/{body['id']}").json() == body
    assert client.get("/api/v1/participants/P1/policies").json()["items"] == [body]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"not a network", "not an ONNX file"),
        (constant_onnx(0.6, 12), "windows of 12"),
        (constant_onnx(1.7, 10), "answered 1.7"),
    ],
    ids=["no ONNX", "another window", "out of range"],
)
def test_what_is_no_policy_is_refused_in_words(client: TestClient, participant_code: str, content: bytes, words: str) -> None:
    answer = post_policy(client, content)
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert words in answer.json()["detail"]
    assert "lyon.onnx" in answer.json()["detail"]
    assert "[N, 10]" in answer.json()["hint"]
    assert client.get("/api/v1/participants/P1/policies").json()["total"] == 0


def test_a_name_is_given_once_and_a_viewer_adds_nothing(
    client: TestClient, client_as: Callable[[str], TestClient], participant_code: str
) -> None:
    assert post_policy(client, constant_onnx(0.6, 10)).status_code == 201
    assert post_policy(client, constant_onnx(0.7, 10)).status_code == 409
    assert post_policy(client_as("viewer"), constant_onnx(0.7, 10), "mine").status_code == 403
    assert post_policy(client_as("clinician"), constant_onnx(0.7, 10), "mine").status_code == 403
    assert post_policy(client_as("engineer"), constant_onnx(0.7, 10), "mine").status_code == 201


def test_a_policy_is_retired_with_a_reason_and_taken_back(client: TestClient, participant_code: str) -> None:
    policy = post_policy(client, constant_onnx(0.6, 10)).json()["id"]
    retired = client.patch(f"/api/v1/policies/{policy}", json={"retired_reason": "too strong"})
    assert retired.json()["retired_reason"] == "too strong"
    assert client.patch(f"/api/v1/policies/{policy}", json={"retired_reason": None}).json()["retired_reason"] is None


def test_the_bundle_is_whole_and_says_for_whom_and_within_which_limits(client: TestClient, upload: Upload) -> None:
    upload("random")
    client.post("/api/v1/participants/P1/snapshots")
    policy = post_policy(client, constant_onnx(0.6, 10)).json()["id"]
    answer = client.get(f"/api/v1/policies/{policy}/bundle", params={"min_ma": 0.5, "max_ma": 3.5, "ramp_ma_per_s": 0.5})
    assert answer.headers["content-type"] == "application/zip"
    assert answer.headers["content-disposition"] == f'attachment; filename="P1-policy-{policy}.zip"'
    manifest = verify_bundle(answer.content)
    assert (manifest.participant, manifest.policy_id, manifest.window, manifest.beta_unit) == ("P1", policy, 10, "uV")
    assert (manifest.min_ma, manifest.max_ma, manifest.cdbs_ma, manifest.ramp_ma_per_s) == (0.5, 3.5, 3.0, 0.5)
    assert manifest.approvals == ()
    vectors = json.loads(zipfile.ZipFile(io.BytesIO(answer.content)).read("test_vectors.json"))
    assert len(vectors["windows"]) >= 50
    assert np.ptp(vectors["windows"]) > 0.5


def test_limits_that_contradict_each_other_make_no_bundle(client: TestClient, participant_code: str) -> None:
    policy = post_policy(client, constant_onnx(0.6, 10)).json()["id"]
    answer = client.get(f"/api/v1/policies/{policy}/bundle", params={"min_ma": 2.0, "max_ma": 1.0})
    assert answer.status_code == 422
    assert "limits" in answer.json()["detail"]


def test_the_pages_show_a_policy_and_take_one_in(client: TestClient, participant_code: str, db: Session) -> None:
    added = client.post(
        "/participants/P1/policies",
        data={"name": "paris"},
        files={"file": ("jane-doe.onnx", constant_onnx(0.5, 10))},
        follow_redirects=True,
    )
    assert added.status_code == 200
    assert "Policy added." in added.text
    assert "paris" in added.text
    assert "jane-doe" not in added.text
    policy = db.query(Policy).one()
    assert policy.config == {"window": 10}
    page = client.post(f"/participants/P1/policies/{policy.id}/retire", data={"reason": "superseded"}, follow_redirects=True)
    assert "superseded" in page.text
    refused = client.post("/participants/P1/policies", data={"name": "x"}, files={"file": ("x.onnx", b"junk")})
    assert refused.status_code == 422
    assert "not an ONNX file" in refused.text


def test_a_student_gets_the_asked_layers_and_a_seed_of_its_own() -> None:
    assert distillation_config(DistilParams(updates=50, hidden=[8]), 1) == {
        "updates": 50, "sigma": 0.3, "seed": 1, "record_every": 1, "hidden": [8],
    }  # fmt: skip


@pytest.mark.parametrize("name", ["\x00", "a\x00b", "a\x1bb", "a\x7fb", "a\x85b", "a\nb", "  ", ""])
def test_a_name_without_a_visible_character_or_with_a_control_character_is_refused(
    client: TestClient, participant_code: str, db: Session, name: str
) -> None:
    files = {"file": ("x.onnx", constant_onnx(0.5, 10))}
    for path in ("/api/v1/participants/P1/policies", "/participants/P1/policies"):
        assert client.post(path, data={"name": name}, files=files).status_code == 422
    assert db.query(Policy).count() == 0


def test_a_control_character_in_a_name_is_named(client: TestClient, participant_code: str) -> None:
    assert "no control characters" in post_policy(client, constant_onnx(0.5, 10), "a\x00b").text  # type: ignore[attr-defined]


def test_a_reason_with_the_zero_character_retires_nothing(client: TestClient, participant_code: str) -> None:
    policy = post_policy(client, constant_onnx(0.6, 10)).json()["id"]  # type: ignore[attr-defined]
    assert client.post(f"/participants/P1/policies/{policy}/retire", data={"reason": "a\x00b"}).status_code == 422
    assert client.get(f"/api/v1/policies/{policy}").json()["retired_reason"] is None
