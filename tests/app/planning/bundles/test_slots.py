"""Bundles for the sessions of a signed plan, as they leave the service and run on the tablet."""

from __future__ import annotations

import html
import io
import zipfile
from collections.abc import Callable
from datetime import UTC, date, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.planning.plans.view import read_plan
from app.planning.sheet.content import card_of
from app.platform import files
from app.platform.errors import Invalid
from app.tables.visits import Visit
from app.tablet.command import control, lines, verified
from app.tablet.live import run_live
from app.tablet.sources import Task, Wish
from ml.deploy.bundle import open_bundle
from ml.deploy.manifest import BundleManifest
from ml.deploy.runtime.control_loop import End
from ml.deploy.runtime.slot import read_withdrawals
from ml.rl import MlpPolicy

TODAY = datetime.now(UTC).date()


def taken(client: TestClient, visit: int, position: int) -> Any:
    return client.get(f"/api/v1/visits/{visit}/plan/sessions/{position}/bundle")


@pytest.fixture
def policies(client: TestClient, study_world: Any) -> list[int]:
    """Two policies with networks that run."""
    made = []
    for seed in (1, 2):
        content = MlpPolicy(10, (8,), mean=1.0, std=0.5, seed=seed).to_onnx()
        posted = client.post("/api/v1/participants/P1/policies", data={"name": f"net-{seed}"}, files={"file": ("x.onnx", content)})
        made.append(int(posted.json()["id"]))
    return made


@pytest.fixture
def signed(client: TestClient, db: Session, study_world: Any, policies: list[int], sign_plan: Callable[..., Any]) -> dict[str, Any]:
    """A plan of today with two policies, two random sessions and cDBS between."""
    db.execute(text("update visit set date = :day where id = :id"), {"day": TODAY, "id": study_world.visit})
    db.commit()
    wanted = {
        "policy_ids": policies,
        "seed": 7,
        "min_ma": 0.5,
        "random_sessions": 1,
        "no_dbs": True,
        "minutes_per_session": 5,
    }
    drafted = client.post(f"/api/v1/visits/{study_world.visit}/plan", json=wanted)
    assert drafted.status_code == 201, drafted.text
    plan: dict[str, Any] = sign_plan(study_world.visit, plan_id=drafted.json()["id"]).json()
    return plan


def manifest_of(client: TestClient, visit: int, position: int) -> BundleManifest:
    key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(client.get("/api/v1/bundle-key").text.strip()))
    answer = taken(client, visit, position)
    assert answer.status_code == 200, answer.text
    return open_bundle(answer.content, key).manifest


@pytest.mark.hazard("H19")
def test_each_session_of_a_signed_plan_has_its_bundle_within_the_signed_limits(
    client: TestClient, db: Session, study_world: Any, signed: dict[str, Any]
) -> None:
    for session in signed["sessions"]:
        if session["controller"] == "no_dbs":
            refused = taken(client, study_world.visit, session["position"])
            assert (refused.status_code, "with the programmer" in refused.json()["hint"]) == (409, True)
            continue
        m = manifest_of(client, study_world.visit, session["position"])
        assert m.slot is not None
        assert (m.slot.plan_id, m.slot.position, m.slot.visit_date) == (signed["id"], session["position"], str(TODAY))
        assert (m.slot.controller, m.slot.minutes, m.slot.repeat) == (session["controller"], 5.0, session["repeat"])
        assert m.slot.plan_sha256 == signed["signature"]["sha256"]
        assert [a.name for a in m.approvals] == ["signer@clinic.example"]
        assert (m.min_ma, m.max_ma, m.cdbs_ma) == (session["min_ma"], session["max_ma"], session["cdbs_ma"])
        assert m.policy_id == session["policy_id"]
        assert (m.schedule is None) == (session["policy_id"] is not None)
        assert m.frozen_after == 5
        assert m.beta_max is not None
    again = taken(client, study_world.visit, signed["sessions"][0]["position"]).content
    assert again == taken(client, study_world.visit, signed["sessions"][0]["position"]).content
    rows = db.execute(text("select policy_id, plan_item_id, sha256 from bundle_release order by id")).all()
    assert len(rows) == len(signed["sessions"]) - 1 + 2, "each time is a row"
    assert len({row.sha256 for row in rows}) == len(signed["sessions"]) - 1, "what is taken again is the same file"
    assert all(row.plan_item_id for row in rows)
    page = client.get(f"/visits/{study_world.visit}/bundles", headers={"Accept": "text/html"}).text
    assert page.count('/bundle" download') == len(signed["sessions"]) - 1


def sheet_of(client: TestClient, visit: int, position: int) -> str:
    with zipfile.ZipFile(io.BytesIO(taken(client, visit, position).content)) as archive:
        return html.unescape(archive.read("sheet.html").decode())


def test_the_sheet_of_a_bundle_says_of_its_session_what_the_sheet_of_the_plan_says(
    client: TestClient, db: Session, study_world: Any, signed: dict[str, Any], tmp_path: Path
) -> None:
    view = read_plan(db, db.get_one(Visit, study_world.visit), SYSTEM)
    signature = signed["signature"]["sha256"][:12]
    for line in view.lines:
        if line.item.controller == "no_dbs":
            assert ("Bundle", "none: off, and on again, by the programmer") in card_of(line, view, None).lines
            continue
        card, sheet = card_of(line, view, None), sheet_of(client, study_world.visit, line.item.position)
        assert f"As on the sheet of plan {signed['id']}: {card.head}, {card.minutes}" in sheet
        for label, words in card.lines:
            assert label == "Bundle" or f"<th>{label}</th><td>{words}</td>" in sheet
        assert all(warning in sheet for warning in card.warnings)
        assert f"signed as <code>{signature}</code>" in sheet
        assert ("Trained by" in sheet, "<th>Scaling</th>" in sheet) == (line.policy is not None,) * 2, "a schedule has no training"
    assert any(card_of(line, view, None).warnings for line in view.lines), "a policy that is not ranked is warned of"


def test_the_sheet_of_a_blinded_session_tells_letters_and_stop_rules_and_not_what_runs(
    client: TestClient, db: Session, study_world: Any, policies: list[int], sign_plan: Callable[..., Any], tmp_path: Path
) -> None:
    db.execute(text("update visit set date = :day where id = :id"), {"day": TODAY, "id": study_world.visit})
    db.commit()
    wanted = {"policy_ids": policies, "seed": 7, "min_ma": 0.5, "random_sessions": 1, "minutes_per_session": 5, "blinded": True}
    plan = client.post(f"/api/v1/visits/{study_world.visit}/plan", json=wanted).json()
    assert sign_plan(study_world.visit, plan_id=plan["id"]).status_code == 200
    letters = [s["label"] for s in plan["sessions"]]
    key = client.get("/api/v1/bundle-key").text.strip()
    common = None
    for session in plan["sessions"]:
        sheet = sheet_of(client, study_world.visit, session["position"])
        assert f"Session {session['label']}" in sheet
        assert "Stop the session and return to the clinical stimulation" in sheet
        assert not [word for word in ("net-1", "net-2", "cDBS 2", "Random", "Design", "Predicted", "Network") if word in sheet]
        limits = sheet.split("<th>Limits</th><td>")[1].split("</td>")[0]
        common = common or limits
        assert limits == common, "the limits of all sessions alike"
        bundle = tmp_path / f"{session['position']}.zip"
        bundle.write_bytes(taken(client, study_world.visit, session["position"]).content)
        told = lines(control(bundle, None, Wish(), Task(key=key, timed=20)))
        assert f"Session {session['label']}, blinded" in told
        assert "net-" not in told
    assert len(set(letters)) == len(letters)


@pytest.mark.hazard("H23")
def test_the_draws_of_a_random_session_are_in_its_bundle_and_the_same_each_time(
    client: TestClient, db: Session, study_world: Any, signed: dict[str, Any]
) -> None:
    session = next(s for s in signed["sessions"] if s["controller"] == "random")
    first = manifest_of(client, study_world.visit, session["position"]).schedule
    for sha256 in db.scalars(text("select sha256 from bundle_release")):
        files.remove(sha256)  # so that it is made again
    second = manifest_of(client, study_world.visit, session["position"]).schedule
    assert first is not None
    assert first == second
    assert sum(hold.steps for hold in first.holds) == 150
    assert all(hold.log_density is not None and hold.amplitude >= (first.lower_bound or 0) for hold in first.holds)
    assert first.seed is not None


@pytest.mark.hazard("H19")
@pytest.mark.hazard("H18")
def test_no_bundle_leaves_for_a_plan_that_may_not_run(
    client: TestClient, db: Session, study_world: Any, policies: list[int], sign_plan: Callable[..., Any]
) -> None:
    def refused(words: str) -> None:
        answer = taken(client, study_world.visit, 1)
        assert answer.status_code == 409, answer.text
        assert words in answer.json()["detail"]
        page = client.get(f"/visits/{study_world.visit}/bundles", headers={"Accept": "text/html"}).text
        assert words in page.replace("&#39;", "'")
        assert '/bundle" download' not in page

    def dated(day: date | None) -> None:
        db.execute(text("update visit set date = :day where id = :id"), {"day": day, "id": study_world.visit})
        db.commit()

    dated(TODAY)
    client.post(f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": policies, "seed": 7})
    refused("is not signed yet")
    sign_plan(study_world.visit)
    assert taken(client, study_world.visit, 1).status_code == 200
    assert taken(client, study_world.visit, 99).status_code == 404
    dated(datetime.now(UTC).astimezone(timezone(timedelta(hours=-12))).date())
    assert taken(client, study_world.visit, 1).status_code == 200, (
        "there the day of the visit has not ended; the tablet goes by its own date"
    )
    dated(TODAY - timedelta(days=2))
    refused("its bundles have expired")
    dated(None)
    refused("has no date")
    dated(TODAY)
    db.execute(text("update plan_item set max_ma = max_ma + 0.5"))
    db.commit()
    refused("was changed after it was signed")


@pytest.mark.hazard("H20")
@pytest.mark.hazard("H18")
def test_a_bundle_that_has_left_is_refused_once_its_policy_or_plan_is_withdrawn(
    client: TestClient, study_world: Any, signed: dict[str, Any], tmp_path: Path
) -> None:
    session = next(s for s in signed["sessions"] if s["policy_id"])
    bundle = tmp_path / "bundle.zip"
    bundle.write_bytes(taken(client, study_world.visit, session["position"]).content)
    key = client.get("/api/v1/bundle-key").text.strip()
    listed = tmp_path / "withdrawn.txt"
    listed.write_bytes(client.get("/api/v1/bundle-withdrawals").content)
    assert read_withdrawals(listed, bytes.fromhex(key)).plans == frozenset()
    retired = client.patch(f"/api/v1/policies/{session['policy_id']}", json={"retired_reason": "a fault was found"})
    assert retired.status_code in (200, 204), retired.text
    listed.write_bytes(client.get("/api/v1/bundle-withdrawals").content)
    task = Task(log=tmp_path / "log.csv", key=key, ledger=tmp_path / "ledger", withdrawn=listed)
    with pytest.raises(Invalid, match=f"policy {session['policy_id']} was withdrawn"):
        run_live(verified(bundle, key), bundle.name, "simulated:P1", task)
    assert taken(client, study_world.visit, session["position"]).status_code == 409
    again = {"policy_ids": [], "random_sessions": 1, "reason": "another day"}
    assert client.post(f"/api/v1/visits/{study_world.visit}/plan", json=again).status_code == 201
    listed.write_bytes(client.get("/api/v1/bundle-withdrawals").content)
    assert read_withdrawals(listed, bytes.fromhex(key)).plans == {signed["id"]}


def test_a_session_runs_from_its_bundle_and_once(client: TestClient, study_world: Any, signed: dict[str, Any], tmp_path: Path) -> None:
    session = next(s for s in signed["sessions"] if s["controller"] == "random")
    bundle, key = tmp_path / "bundle.zip", client.get("/api/v1/bundle-key").text.strip()
    bundle.write_bytes(taken(client, study_world.visit, session["position"]).content)
    task = Task(log=tmp_path / "log.csv", key=key, ledger=tmp_path / "ledger", participant="P1")
    outcome, _ = run_live(verified(bundle, key), bundle.name, "simulated:P1:2", task)
    assert outcome.end is End.COMPLETE
    bundle.write_bytes(taken(client, study_world.visit, session["position"]).content)
    with pytest.raises(Invalid, match="a slot runs once"):
        run_live(verified(bundle, key), bundle.name, "simulated:P1:2", Task(log=tmp_path / "b.csv", key=key, ledger=tmp_path / "ledger"))
