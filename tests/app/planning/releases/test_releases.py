"""The release of a policy: signed over its bytes and limits, broken by any change, and what it means for plans."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, text
from sqlalchemy.orm import Session

from app.platform import files
from app.settings import get_settings
from app.tables.audit import Signature
from app.tables.learning import Policy
from ml.rl import MlpPolicy
from tests.app.planning.serious_events import clear, event
from tests.conftest import PASSWORD

PAGE = {"Accept": "text/html"}
BROKEN = "Signature broken: this policy was changed"
LIMITS = {"min_ma": 0.5, "max_ma": 3.0, "ramp_ma_per_s": 1.5}
Clients = Callable[[str], TestClient]


@pytest.fixture
def policy(client: TestClient, participant_code: str) -> int:
    """A policy made elsewhere, which the administrator has added."""
    content = MlpPolicy(10, (20, 10), mean=1.0, std=0.5, seed=1).to_onnx()
    posted = client.post("/api/v1/participants/P1/policies", data={"name": "lyon"}, files={"file": ("x.onnx", content)})
    return int(posted.json()["id"])


def release(client: TestClient, policy: int, **more: Any) -> Any:
    return client.post(f"/api/v1/policies/{policy}/release", json={"password": PASSWORD} | LIMITS | more)


def give_a_network(db: Session, policy: int) -> None:
    """Store a file that a bundle can be made of."""
    content = MlpPolicy(10, (20, 10), mean=1.0, std=0.5, seed=policy).to_onnx()
    db.get_one(Policy, policy).onnx_sha256 = files.store(db, content).sha256


def read(client: TestClient, policy: int) -> dict[str, Any]:
    found: dict[str, Any] = client.get(f"/api/v1/policies/{policy}/release").json()
    return found


def test_a_clinician_releases_a_policy_over_its_bytes_and_limits(client: TestClient, client_as: Clients, db: Session, policy: int) -> None:
    assert (read(client, policy)["signature_state"], read(client, policy)["signature"]) == ("none", None)
    done = release(client_as("clinician"), policy)
    assert (done.status_code, done.json()["signature_state"]) == (201, "stands"), done.text
    signature = done.json()["signature"]
    assert (signature["signer"], signature["meaning"]) == ("clinician@clinic.example", "released for testing in participants")
    assert done.json()["limits"] == LIMITS | {"cdbs_ma": 3.0, "hemisphere": None}
    content, stored = db.scalars(select(Signature)).one().content, db.get_one(Policy, policy)
    assert (content["onnx_sha256"], content["limits"]["max_ma"]) == (stored.onnx_sha256, 3.0)
    page = client.get(f"/participants/P1/policies/{policy}/bundle", headers=PAGE).text
    assert (signature["sha256"] in page, BROKEN in page) == (True, False)


def test_whoever_brought_it_an_engineer_and_a_wrong_password_release_nothing(
    client: TestClient, client_as: Clients, db: Session, policy: int
) -> None:
    own = release(client, policy)
    assert (own.status_code, "You brought policy 'lyon' from elsewhere yourself." in own.text) == (403, True)
    assert "Release lyon" not in client.get(f"/participants/P1/policies/{policy}/bundle", headers=PAGE).text
    assert release(client_as("engineer"), policy).status_code == 403
    clinician = client_as("clinician")
    assert clinician.post(f"/api/v1/policies/{policy}/release", json=LIMITS).status_code == 422
    assert release(clinician, policy, password="a wrong guess").status_code == 403
    form = {"min_ma": "0.5", "max_ma": "3.25", "ramp_ma_per_s": "1.5", "password": "a wrong guess"}
    page = clinician.post(f"/participants/P1/policies/{policy}/release", data=form, headers=PAGE)
    assert (page.status_code, "The password is wrong." in page.text, 'value="3.25"' in page.text) == (403, True, True)
    assert db.scalars(select(Signature)).all() == []
    sent = clinician.post(
        f"/participants/P1/policies/{policy}/release", data=form | {"password": PASSWORD}, headers=PAGE, follow_redirects=False
    )
    assert (sent.status_code, read(client, policy)["limits"]["max_ma"]) == (303, 3.25)


def test_whoever_brought_a_policy_does_not_release_what_was_made_from_it(
    client: TestClient, client_as: Clients, db: Session, study_world: Any, external: int
) -> None:
    tuned, unrelated, student, _ = study_world.policies
    brought = db.get_one(Policy, external)
    brought.created_by = "admin@clinic.example"
    for made in (tuned, student):
        give_a_network(db, made)
    db.get_one(Policy, tuned).parent_id = external
    db.commit()
    assert db.get_one(Policy, student).teacher_id == tuned
    for made in (tuned, student):
        refused = release(client, made)
        assert (refused.status_code, f"You brought policy '{brought.name}' from elsewhere" in refused.text) == (403, True)
        page = client.get(f"/participants/P1/policies/{made}/bundle", headers=PAGE).text
        assert ("which this one was made from" in page, f"Release {db.get_one(Policy, made).name}" in page) == (True, False)
    assert release(client, unrelated).status_code == 201, "its line holds nothing from elsewhere"
    assert release(client_as("clinician"), tuned).status_code == 201


def test_a_policy_under_which_something_serious_happened_is_not_released_until_it_is_cleared(
    client: TestClient, client_as: Clients, policy: int
) -> None:
    found = event(client, policy)
    clinician = client_as("clinician")
    refused = release(clinician, policy)
    assert (refused.status_code, f"adverse event {found['id']}" in refused.json()["detail"]) == (409, True), refused.text
    clear(clinician, found)
    assert release(clinician, policy).status_code == 201


def test_a_retired_policy_and_impossible_limits_are_refused(client: TestClient, client_as: Clients, policy: int) -> None:
    clinician = client_as("clinician")
    assert release(clinician, policy, min_ma=3.0, max_ma=1.0).status_code == 422
    client.patch(f"/api/v1/policies/{policy}", json={"retired_reason": "speech"})
    assert release(clinician, policy).status_code == 409


@pytest.mark.parametrize(
    "change",
    [
        "update policy set onnx_sha256 = (select min(sha256) from stored_file where sha256 <> onnx_sha256)",
        "update policy set checkpoint_sha256 = onnx_sha256",
        "update policy set name = 'another'",
        "update policy set config = '{\"window\": 11}'",
        "update signature set content = jsonb_set(content, '{limits,max_ma}', '25')",
    ],
)
def test_any_change_breaks_it_visibly(client: TestClient, client_as: Clients, owner_db: Session, policy: int, change: str) -> None:
    other = MlpPolicy(10, (20, 10), mean=1.0, std=0.5, seed=2).to_onnx()
    client.post("/api/v1/participants/P1/policies", data={"name": "second"}, files={"file": ("x.onnx", other)})
    release(client_as("clinician"), policy)
    table = change.split()[1]
    owner_db.execute(text(f"alter table {table} disable trigger user"))  # what the owner can do, and no service
    where = f"id = {policy}" if table == "policy" else "true"
    assert owner_db.execute(text(f"{change} where {where}")).rowcount == 1  # type: ignore[attr-defined]
    owner_db.commit()
    assert read(client, policy)["signature_state"] == "broken"
    assert BROKEN in client.get(f"/participants/P1/policies/{policy}/bundle", headers=PAGE).text


def test_retiring_and_taking_back_breaks_nothing(client: TestClient, client_as: Clients, policy: int) -> None:
    release(client_as("clinician"), policy)
    client.patch(f"/api/v1/policies/{policy}", json={"retired_reason": "speech"})
    client.patch(f"/api/v1/policies/{policy}", json={"retired_reason": None})
    assert read(client, policy)["signature_state"] == "stands"


class TestPlans:
    """Effect of a release on the plans with its policy."""

    @pytest.fixture
    def drafted(self, client: TestClient, study_world: Any) -> int:
        body = {"policy_ids": [study_world.policies[0]], "seed": 7, "min_ma": 0.5, "max_ma": 3.5}
        answer = client.post(f"/api/v1/visits/{study_world.visit}/plan", json=body)
        assert answer.status_code == 201, answer.text
        return int(study_world.policies[0])

    def test_a_plan_is_approved_without_releases_unless_they_are_asked_for(
        self, client_as: Clients, study_world: Any, drafted: int, sign_plan: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("BETALOOP_REQUIRE_RELEASED_POLICIES", "true")
        get_settings.cache_clear()
        refused = sign_plan(study_world.visit)
        assert (refused.status_code, "is not released for testing in participants" in refused.text) == (409, True)
        assert release(client_as("clinician"), drafted, max_ma=3.5).status_code == 201
        assert sign_plan(study_world.visit).status_code == 200

    def test_a_plan_beyond_the_limits_of_a_release_is_not_approved(
        self, client_as: Clients, study_world: Any, drafted: int, sign_plan: Callable[..., Any]
    ) -> None:
        clinician = client_as("clinician")
        for narrower in ({"max_ma": 3.4}, {"min_ma": 0.6}, {"ramp_ma_per_s": 1.4}):
            assert release(clinician, drafted, **{"max_ma": 3.5} | narrower).status_code == 201
            refused = sign_plan(study_world.visit)
            assert (refused.status_code, "goes beyond the limits" in refused.text) == (409, True), narrower
        assert release(clinician, drafted, max_ma=3.5).status_code == 201
        assert sign_plan(study_world.visit).status_code == 200

    def test_a_release_as_its_page_proposes_it_allows_a_plan_by_its_own_defaults(
        self, client: TestClient, client_as: Clients, db: Session, study_world: Any, sign_plan: Callable[..., Any]
    ) -> None:
        give_a_network(db, study_world.policies[0])
        db.commit()
        amplitude = {"settings": {"cdbs_amplitude_ma": 3.1249}, "reason": "programmed"}  # 1.56245 mA/s over a period of 2 s
        assert client.put("/api/v1/participants/P1/settings", json=amplitude).status_code == 200
        policy, clinician = study_world.policies[0], client_as("clinician")
        form = clinician.get(f"/participants/P1/policies/{policy}/bundle", headers=PAGE).text.split('id="release"')[1]
        proposed = {name: re.search(rf'name="{name}"[^>]*?value="([^"]+)"', form) for name in LIMITS}
        shown = {name: found[1] for name, found in proposed.items() if found}
        assert set(shown) == set(LIMITS)
        path = f"/participants/P1/policies/{policy}/release"
        assert clinician.post(path, data=shown | {"password": PASSWORD}, headers=PAGE, follow_redirects=False).status_code == 303
        assert client.post(f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [policy], "seed": 7}).status_code == 201
        approved = sign_plan(study_world.visit)
        assert approved.status_code == 200, approved.text

    def test_a_policy_that_was_changed_since_its_release_is_in_no_approved_plan(
        self, client_as: Clients, study_world: Any, drafted: int, owner_db: Session, sign_plan: Callable[..., Any]
    ) -> None:
        assert release(client_as("clinician"), drafted, max_ma=3.5).status_code == 201
        owner_db.execute(text("update policy set seed = 77 where id = :policy"), {"policy": drafted})
        owner_db.commit()
        refused = sign_plan(study_world.visit)
        assert (refused.status_code, "was changed since it was released" in refused.text) == (409, True)
