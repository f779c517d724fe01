"""Checks of converted copies: by form and REST, judged by the service, on the bundle's page, on the sheets, and in the trail."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.planning.bundles.ports import lines_of
from app.platform import files
from app.tables.audit import AuditEvent
from ml.deploy.bundle import open_bundle
from ml.deploy.ports.check import port_vectors
from ml.rl import MlpPolicy
from tests.app.planning.bundles.port_answers import port_answers


@pytest.fixture
def policy(client: TestClient, participant_code: str) -> int:
    content = MlpPolicy(10, (20, 10), mean=1.0, std=0.5, seed=1).to_onnx()
    posted = client.post("/api/v1/participants/P1/policies", data={"name": "lyon"}, files={"file": ("x.onnx", content)})
    return int(posted.json()["id"])


@pytest.fixture
def bundle(client: TestClient, policy: int) -> bytes:
    return bytes(client.get(f"/api/v1/policies/{policy}/bundle").content)


def check(client: TestClient, policy: int, answers: bytes, target: str = "TFLite", **more: str) -> Any:
    data = {"target": target, **more}
    return client.post(f"/api/v1/policies/{policy}/port-checks", data=data, files={"file": ("answers.csv", answers)})


def test_the_service_judges_the_answers_itself(client: TestClient, policy: int, bundle: bytes) -> None:
    same = check(client, policy, port_answers(bundle)).json()
    assert (same["verdict"], same["faults"]) == ("same", [])
    wrong = check(client, policy, port_answers(bundle, 0.25)).json()
    assert (wrong["verdict"], [fault["code"] for fault in wrong["faults"]]) == ("not this policy", ["lost_sample"])
    assert wrong["headline"].endswith("TFLite: a lost sample gets 0.75 mA: not to be connected")
    listed = client.get(f"/api/v1/policies/{policy}/port-checks").json()
    assert [row["id"] for row in listed] == [wrong["id"], same["id"]]
    assert files.read(wrong["answers_sha256"]) == port_answers(bundle, 0.25)
    assert files.read(wrong["bundle_sha256"]) == bundle


def test_the_page_and_the_page_for_the_file_say_it(client: TestClient, policy: int, bundle: bytes) -> None:
    page = client.get(f"/participants/P1/policies/{policy}/bundle").text
    assert "No copy was checked" in page
    form = {"data": {"target": "TFLite <1>"}, "files": {"file": ("answers.csv", port_answers(bundle, 0.25))}}
    sent = client.post(f"/participants/P1/policies/{policy}/ports", headers={"Accept": "text/html"}, follow_redirects=False, **form)
    assert sent.status_code == 303, sent.text
    (row,) = client.get(f"/api/v1/policies/{policy}/port-checks").json()
    page = client.get(f"/participants/P1/policies/{policy}/bundle").text
    assert "TFLite &lt;1&gt;: a lost sample gets 0.75 mA: not to be connected" in page
    assert row["answers_sha256"][:12] in page
    printed = client.get(f"/api/v1/policies/{policy}/port-checks/{row['id']}/page").text
    assert row["answers_sha256"] in printed
    assert "Put the guard in front of the network" in printed


def test_an_unusable_table_is_refused_with_line_and_remedy_and_nothing_is_kept(
    client: TestClient, policy: int, bundle: bytes, db: Session
) -> None:
    cut = b"\n".join(port_answers(bundle).splitlines()[:100])
    refused = check(client, policy, cut)
    assert refused.status_code == 422
    assert refused.json()["detail"] == "The answers cannot be used: line 100: the file ends here, after 99 of 400 rows."
    assert "Write every row" in refused.json()["hint"]
    form = {"data": {"target": "TFLite"}, "files": {"file": ("answers.csv", cut)}}
    page = client.post(f"/participants/P1/policies/{policy}/ports", headers={"Accept": "text/html"}, **form)
    assert page.status_code == 422
    assert "line 100" in page.text
    assert 'value="TFLite"' in page.text, "what was typed is not lost"
    assert db.scalar(text("select count(*) from port_check")) == 0


def test_a_check_needs_a_bundle_that_was_taken(client: TestClient, policy: int, bundle: bytes, db: Session) -> None:
    missing = check(client, policy, port_answers(bundle), bundle="ab" * 32)
    assert missing.status_code == 404
    other = client.post(
        "/api/v1/participants/P1/policies",
        data={"name": "second"},
        files={"file": ("x.onnx", MlpPolicy(10, (20, 10), mean=1.0, std=0.5, seed=2).to_onnx())},
    ).json()["id"]
    never = check(client, other, port_answers(bundle))
    assert never.status_code == 409
    assert "Take the bundle" in never.json()["hint"]
    client.get(f"/api/v1/policies/{other}/bundle")
    assert "line 2: hash" in check(client, other, port_answers(bundle)).json()["detail"], "answers to another policy's bundle"


def test_whoever_may_only_read_checks_nothing(client_as: Callable[[str], TestClient], policy: int, bundle: bytes) -> None:
    assert check(client_as("viewer"), policy, port_answers(bundle)).status_code == 403


def test_a_check_is_in_the_trail_and_never_changed(client: TestClient, policy: int, bundle: bytes, db: Session) -> None:
    row = check(client, policy, port_answers(bundle, 0.25)).json()
    (event,) = db.query(AuditEvent).filter(AuditEvent.entity == "port_check").all()
    assert (event.action, event.after["verdict"], "result" in event.after) == ("insert", "not this policy", False)
    assert "checked a port of policy lyon of P1, TFLite: not this policy" in client.get("/audit", headers={"Accept": "text/html"}).text
    with pytest.raises(DBAPIError, match="never changed"):
        db.execute(text("update port_check set verdict = 'same'"))
    assert row["created_by"] == event.actor


def test_sheets_have_the_newest_check_of_each_copy_with_its_hash(client: TestClient, policy: int, bundle: bytes, db: Session) -> None:
    check(client, policy, port_answers(bundle, 0.25))
    newer = check(client, policy, port_answers(bundle)).json()
    check(client, policy, port_answers(bundle, 0.5), target="C")
    said = lines_of(db, [policy])[policy]
    assert f"TFLite: same (answers {newer['answers_sha256'][:12]})" in said
    assert "C: a lost sample gets 1.50 mA: not to be connected" in said
    assert "0.75 mA" not in said


def test_a_bundle_of_recorded_beta_has_windows_of_each_visit(client: TestClient, study_world: Any) -> None:
    onnx = MlpPolicy(10, (20, 10), mean=1.0, std=0.5, seed=1).to_onnx()
    policy = client.post("/api/v1/participants/P1/policies", data={"name": "lyon"}, files={"file": ("x.onnx", onnx)}).json()["id"]
    answer = client.get(f"/api/v1/policies/{policy}/bundle")
    assert answer.status_code == 200, answer.text
    content = answer.content
    vectors = port_vectors(content, open_bundle(content).manifest)
    assert "visit 1" in vectors.kind
    assert np.isfinite(vectors.dose).sum() == 345
