"""Release of bundles: signed, within the stimulator's own limits, with the plan's approval, and in the audit trail."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import onnx
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.planning.bundles.repository import releases
from app.planning.bundles.service import approvals
from app.planning.plans.limits import device_limits
from app.platform import files
from app.study.repository import participant_by_code
from app.tables.audit import AuditEvent
from app.tables.learning import Policy
from app.tables.participants import Hemisphere
from app.tables.recordings import Device, Recording
from ml.deploy.bundle import open_bundle, verify_bundle
from ml.deploy.runtime.envelope import BetaSample, Signal
from ml.rl import MlpPolicy


@pytest.fixture
def policy(client: TestClient, participant_code: str) -> int:
    content = MlpPolicy(10, (20, 10), mean=1.0, std=0.5, seed=1).to_onnx()
    posted = client.post("/api/v1/participants/P1/policies", data={"name": "lyon"}, files={"file": ("x.onnx", content)})
    return int(posted.json()["id"])


def take(client: TestClient, policy: int, **query: Any) -> Any:
    return client.get(f"/api/v1/policies/{policy}/bundle", params=query)


def record_limits(db: Session, limits: dict[str, Any], day: int = 1, hemisphere: Hemisphere | None = None) -> None:
    participant = participant_by_code(db, "P1", SYSTEM)
    device = Device(participant_id=participant.id, pseudonym=f"d{day}", kind="rcs")
    db.add(device)
    db.flush()
    row = Recording(
        participant_id=participant.id, device_id=device.id, fingerprint=f"f{day}", hemisphere=hemisphere, clock="pc",
        started_at=f"2026-03-{day:02d}T09:00:00Z", duration_s=1.0, details={"limits": limits},
    )  # fmt: skip
    db.add(row)
    db.commit()


def test_a_bundle_is_signed_with_the_key_that_the_service_tells(client: TestClient, policy: int) -> None:
    key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(client.get("/api/v1/bundle-key").text.strip()))
    opened = open_bundle(take(client, policy).content, key)
    assert opened.manifest.public_key == key.public_bytes_raw().hex()
    controller, signal = opened.controller(), Signal("uV", "table")
    decisions = [controller.decide(2.0 * k, BetaSample(2.0 * k, 1.0 + 0.1 * (k % 2), signal)) for k in range(12)]
    assert [d.fallback for d in decisions] == [True] * 9 + [False] * 3
    assert all(np.isfinite(d.amplitude_ma) for d in decisions)


def test_defaults_are_zero_to_cdbs_and_say_that_nobody_stated_them(client: TestClient, policy: int) -> None:
    manifest = verify_bundle(take(client, policy).content)
    assert (manifest.min_ma, manifest.max_ma, manifest.ramp_ma_per_s) == (0.0, 3.0, 1.5)
    assert (manifest.limits_stated_by, manifest.device_max_ma) == (None, None)


@pytest.mark.hazard("H05")
def test_the_stimulators_limits_are_the_default_and_cannot_be_left(client: TestClient, policy: int, db: Session) -> None:
    record_limits(
        db, {"group A": {"program 0": {"lower_ma": 0.4, "upper_ma": 3.4}}, "group B": {"program 0": {"lower_ma": 0.2, "upper_ma": 5.0}}}
    )
    manifest = verify_bundle(take(client, policy).content)
    assert (manifest.min_ma, manifest.max_ma, manifest.device_min_ma, manifest.device_max_ma) == (0.4, 3.0, 0.4, 3.4)
    assert verify_bundle(take(client, policy, max_ma=3.4).content).max_ma == 3.4
    for query, word in [
        ({"max_ma": 3.5}, "above the stimulator's own limit, 3.4 mA"),
        ({"min_ma": 0.1}, "below the stimulator's own limit"),
    ]:
        refused = take(client, policy, **query)
        assert refused.status_code == 422
        assert word in refused.json()["detail"]


def test_a_stimulator_that_allows_less_than_cdbs_makes_no_bundle(client: TestClient, policy: int, db: Session) -> None:
    record_limits(db, {"group A": {"program 0": {"lower_ma": 0.0, "upper_ma": 2.5}}})
    assert take(client, policy).status_code == 422


def test_the_newest_recording_of_the_side_states_the_limits(client: TestClient, policy: int, db: Session) -> None:
    participant = participant_by_code(db, "P1", SYSTEM)
    assert device_limits(db, participant, None) is None
    record_limits(db, {"group A": {"program 0": {"lower_ma": 0.0, "upper_ma": 3.4}}}, 1, Hemisphere.LEFT)
    record_limits(db, {"group A": {"program 0": {"lower_ma": 0.0, "upper_ma": 4.4}}}, 2, Hemisphere.RIGHT)
    record_limits(db, {}, 3)
    found = {side: device_limits(db, participant, side) for side in (None, Hemisphere.LEFT, Hemisphere.RIGHT)}
    assert {side: limits.max_ma for side, limits in found.items() if limits} == {None: 4.4, Hemisphere.LEFT: 3.4, Hemisphere.RIGHT: 4.4}


def test_the_audit_trail_says_who_took_which_limits_out(
    client: TestClient, client_as: Callable[[str], TestClient], policy: int, db: Session
) -> None:
    answer = take(client_as("clinician"), policy, min_ma=0.5, max_ma=2.0 + 1.0, ramp_ma_per_s=0.25)
    manifest = verify_bundle(answer.content)
    assert manifest.limits_stated_by.startswith("clinician@clinic.example, 20")
    events = db.query(AuditEvent).filter(AuditEvent.entity == "stored_file", AuditEvent.reason.like("controller bundle%")).all()
    assert [(e.actor, e.action) for e in events] == [("clinician@clinic.example", "insert")]
    assert events[0].reason == f"controller bundle of P1, policy {policy}: 0.5 to 3 mA, cDBS 3 mA, ramp 0.25 mA/s"


def test_a_release_is_a_row_and_no_sentence_is_read_for_it(
    client: TestClient, client_as: Callable[[str], TestClient], policy: int, db: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.planning.plans.wording.release_reason", lambda manifest: "worded anew")
    content = take(client_as("clinician"), policy, min_ma=0.5, max_ma=3.0, ramp_ma_per_s=0.25).content
    (row,) = releases(db, policy)
    assert (row.created_by, row.policy_id, row.hemisphere, row.approvals) == ("clinician@clinic.example", policy, None, [])
    assert (row.min_ma, row.max_ma, row.cdbs_ma, row.ramp_ma_per_s) == (0.5, 3.0, 3.0, 0.25)
    assert files.read(row.sha256) == content
    page = client.get(f"/participants/P1/policies/{policy}/bundle").text
    assert "clinician@clinic.example" in page
    assert "0.5 to 3 mA, cDBS 3 mA, ramp 0.25 mA/s" in page
    with pytest.raises(DBAPIError, match="never changed"):
        db.execute(text("update bundle_release set max_ma = 4"))


def test_an_approved_plan_is_the_approval_of_its_policies(
    client: TestClient, policy: int, db: Session, sign_plan: Callable[..., Any]
) -> None:
    assert approvals(db, participant_by_code(db, "P1", SYSTEM).id, policy) == ()
    visit = client.get("/api/v1/participants/P1/visits").json()
    visit_id = (visit["items"] if isinstance(visit, dict) else visit)[0]["id"]
    drafted = client.post(f"/api/v1/visits/{visit_id}/plan", json={"policy_ids": [policy]})
    assert drafted.status_code == 201, drafted.text
    assert approvals(db, participant_by_code(db, "P1", SYSTEM).id, policy) == (), "a draft approves nothing"
    approved = sign_plan(visit_id)
    assert approved.status_code in (200, 201), approved.text
    (approval,) = verify_bundle(take(client, policy).content).approvals
    assert (approval.name, approval.role) == ("signer@clinic.example", "approver of plans")
    assert "visit 1" in approval.statement


def test_the_page_offers_the_stimulators_limits(client: TestClient, policy: int, db: Session) -> None:
    assert f'href="/participants/P1/policies/{policy}/bundle"' in client.get(f"/participants/P1/policies/{policy}").text
    page = client.get(f"/participants/P1/policies/{policy}/bundle")
    assert "No recording holds the stimulator&#39;s own limits" in page.text
    record_limits(db, {"group A": {"program 0": {"lower_ma": 0.4, "upper_ma": 3.4}}})
    page = client.get(f"/participants/P1/policies/{policy}/bundle")
    assert "The stimulator itself allows 0.4 to 3.4 mA." in page.text
    assert 'name="min_ma" type="number" value="0.4"' in page.text


def test_the_page_gives_the_bundle_and_keeps_what_was_typed_where_it_cannot(client: TestClient, policy: int) -> None:
    page = f"/participants/P1/policies/{policy}/bundle"
    assert "No bundle of this policy has been taken" in client.get(page).text
    typed = {"min_ma": "0.5", "max_ma": "3", "ramp_ma_per_s": "0.25"}
    given = client.post(page, data=typed)
    assert given.headers["content-type"] == "application/zip"
    manifest = verify_bundle(given.content)
    assert (manifest.min_ma, manifest.max_ma, manifest.ramp_ma_per_s) == (0.5, 3.0, 0.25)
    assert manifest.limits_stated_by.startswith("admin@clinic.example")
    assert "0.5 to 3 mA, cDBS 3 mA, ramp 0.25 mA/s" in client.get(page).text
    for change, message in [
        ({"min_ma": "2.5", "max_ma": "1"}, "the amplitude limits must rise"),
        ({"ramp_ma_per_s": "0"}, "Fastest change"),
        ({"ramp_ma_per_s": "nan"}, "Fastest change"),
        ({"max_ma": "1e3"}, "Highest amplitude"),
        ({"max_ma": "2.9"}, "cDBS amplitude 3.0 mA must lie within the limits"),
        ({"hemisphere": "middle"}, "Hemisphere"),
    ]:
        refused = client.post(page, data=typed | change)
        assert refused.status_code == 422, change
        assert message in refused.text
        (name,) = change.keys() - {"max_ma"} or change.keys()
        assert f'value="{change[name]}"' in refused.text or name == "hemisphere", "what was typed is kept"


def test_each_side_has_its_own_bundle_and_another_is_refused(client: TestClient, policy: int) -> None:
    stated = {"number": 9, "cdbs_amplitudes": [{"hemisphere": "left", "amplitude_ma": 2.5}, {"hemisphere": "right", "amplitude_ma": 3.5}]}
    assert client.post("/api/v1/participants/P1/visits", json=stated).status_code == 201
    page = f"/participants/P1/policies/{policy}/bundle"
    assert "<option selected>left</option><option>right</option>" in client.get(page).text
    typed = {"min_ma": "0.5", "max_ma": "3.5", "ramp_ma_per_s": "0.5", "hemisphere": "right"}
    manifest = verify_bundle(client.post(page, data=typed).content)
    assert (manifest.hemisphere, manifest.cdbs_ma) == ("right", 3.5)
    assert client.post(page, data=typed | {"hemisphere": "middle"}).status_code == 422
    assert client.post(page, data=typed | {"hemisphere": ""}).status_code == 422
    assert client.get(f"/api/v1/policies/{policy}/bundle").status_code == 422, "which side must be said"


def stored(db: Session) -> int:
    return db.query(AuditEvent).filter(AuditEvent.entity == "stored_file", AuditEvent.reason.like("controller bundle%")).count()


def test_the_same_bundle_taken_twice_is_one_file_and_stands_twice_in_the_audit_trail(
    client: TestClient, client_as: Any, policy: int, db: Session
) -> None:
    first, second, others = (take(who, policy).content for who in (client, client, client_as("clinician")))
    assert first == second == others
    assert verify_bundle(first).taken_by.startswith("admin@clinic.example, 20"), "the sheet says who took it first"
    events = db.query(AuditEvent).filter(AuditEvent.entity == "bundle_release").order_by(AuditEvent.id).all()
    assert [e.actor for e in events] == ["admin@clinic.example", "admin@clinic.example", "clinician@clinic.example"]
    assert (stored(db), len({e.after["sha256"] for e in events if e.after})) == (1, 1)
    path = files.path_of(releases(db, policy)[0].sha256)
    path.chmod(0o600)
    path.write_bytes(b"no bundle")
    assert verify_bundle(take(client, policy).content).taken_by != verify_bundle(first).taken_by, "what was damaged is made anew"


def test_what_a_bundle_holds_makes_it_another(client: TestClient, client_as: Any, policy: int, db: Session) -> None:
    """Other limits, another stater of them, and other settings are other bundles; each is stored once."""
    for _ in range(2):
        for who, limits in ((client, {}), (client, {"max_ma": 3.2}), (client, {"max_ma": 3.4})):
            assert take(who, policy, **limits).status_code == 200
    assert stored(db) == 3
    assert verify_bundle(take(client_as("clinician"), policy, max_ma=3.2).content).limits_stated_by.startswith("clinician@")
    assert stored(db) == 4
    changed = {"settings": {"cdbs_amplitude_ma": 2.9}, "reason": "follow-up"}
    assert client.put("/api/v1/participants/P1/settings", json=changed).status_code == 200
    assert verify_bundle(take(client, policy).content).cdbs_ma == 2.9
    assert stored(db) == 5


def test_who_may_only_read_takes_no_bundle_and_leaves_no_trace(client_as: Any, policy: int, db: Session) -> None:
    viewer = client_as("viewer")
    assert take(viewer, policy).status_code == 403
    assert take(viewer, policy, max_ma=3.2).status_code == 403
    page = viewer.get(f"/participants/P1/policies/{policy}/bundle")
    assert page.status_code == 200
    assert 'name="max_ma"' not in page.text
    typed = {"min_ma": "0.5", "max_ma": "3", "ramp_ma_per_s": "0.25"}
    assert viewer.post(f"/participants/P1/policies/{policy}/bundle", data=typed).status_code == 403
    assert releases(db, policy) == []
    for role in ("clinician", "engineer"):
        assert take(client_as(role), policy, max_ma=3.2).status_code == 200
    assert {release.created_by for release in releases(db, policy)} == {"clinician@clinic.example", "engineer@clinic.example"}


@pytest.mark.parametrize("harm", ["missing", "damaged"])
def test_a_policy_whose_stored_file_is_gone_is_named(client: TestClient, policy: int, db: Session, harm: str) -> None:
    path = files.path_of(db.get_one(Policy, policy).onnx_sha256)
    path.unlink() if harm == "missing" else path.write_bytes(b"other bytes")
    answer = take(client, policy)
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert "policy 'lyon' is missing or damaged" in answer.json()["detail"]
    assert "backup" in answer.json()["hint"]
    page = client.get(f"/participants/P1/policies/{policy}/bundle")
    assert page.status_code == 200
    assert "is missing or damaged" in page.text


def test_a_plain_network_made_elsewhere_leaves_with_its_c_header_and_the_page_says_why_another_does_not(
    client: TestClient, participant_code: str
) -> None:
    from app.learning.policies import constant_onnx

    def added(name: str, content: bytes) -> int:
        posted = client.post("/api/v1/participants/P1/policies", data={"name": name}, files={"file": ("x.onnx", content)})
        return int(posted.json()["id"])

    model = onnx.load_model_from_string(MlpPolicy(10, (6,), mean=1.0, std=0.5, seed=4).to_onnx())
    del model.metadata_props[:]  # nothing says that betaloop wrote it
    plain, constant = added("plain", model.SerializeToString()), added("constant", constant_onnx(0.7, 10))
    assert verify_bundle(take(client, plain).content).layers == (10, 6, 1)
    assert "betaloop_controller.h" in client.get(f"/participants/P1/policies/{plain}/bundle").text
    assert "its operator Shape is none of a plain network" in str(verify_bundle(take(client, constant).content).no_header)
    page = client.get(f"/participants/P1/policies/{constant}/bundle").text
    assert "No C header" in page
    assert "its operator shape is none of a plain network" in page.lower()


def test_the_key_is_told_to_those_signed_in_alone(client: TestClient, service_app: Any) -> None:
    assert TestClient(service_app).get("/api/v1/bundle-key").status_code == 401
    assert len(client.get("/api/v1/bundle-key").text.strip()) == 64
