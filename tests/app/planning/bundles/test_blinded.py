"""The bundles of a blinded plan look alike, run as the open ones do, and their logs come back by their slots."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import re
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform import files as stored
from app.platform.errors import Invalid
from app.tablet.command import control, lines
from app.tablet.sources import Task, Wish
from ml.deploy.bundle import BundleError, open_bundle
from ml.deploy.manifest import BundleManifest
from ml.deploy.runtime.envelope import OF_THE_CONTROLLER, reason_names
from ml.deploy.runtime.slot import SEALED
from ml.rl import MlpPolicy

TODAY = datetime.now(UTC).date()
TELLING = ("net-", "rl", "distilled", "random", "paper", "stratified", "relu", "constant")


@pytest.fixture
def policies(client: TestClient, study_world: Any) -> list[int]:
    """A small network and a large one, which jumps between its ends at the smallest change of beta: limits and ramp bound it."""
    made = []
    for name, layers, std in (("net-small", (8,), 0.5), ("net-large", (96, 96), 1e-3)):
        content = MlpPolicy(10, layers, mean=1.0, std=std, seed=1).to_onnx()
        posted = client.post("/api/v1/participants/P1/policies", data={"name": name}, files={"file": ("x.onnx", content)})
        made.append(int(posted.json()["id"]))
    return made


@pytest.fixture
def plan(client: TestClient, db: Session, study_world: Any, policies: list[int], sign_plan: Callable[..., Any]) -> dict[str, Any]:
    """A blinded plan of today: two policies, cDBS between, a random session; who may see it all knows what is what."""
    client.put("/api/v1/participants/P1/settings", json={"settings": {"design": "stratified"}})
    db.execute(text("update visit set date = :day where id = :id"), {"day": TODAY, "id": study_world.visit})
    db.commit()
    wanted = {"policy_ids": policies, "seed": 7, "min_ma": 0.5, "random_sessions": 1, "minutes_per_session": 5, "blinded": True}
    drafted = client.post(f"/api/v1/visits/{study_world.visit}/plan", json=wanted)
    assert drafted.status_code == 201, drafted.text
    assert sign_plan(study_world.visit, plan_id=drafted.json()["id"]).status_code == 200
    return dict(drafted.json())


@pytest.fixture
def bundles(client: TestClient, study_world: Any, plan: dict[str, Any]) -> dict[int, bytes]:
    """By position."""
    found = {}
    for session in plan["sessions"]:
        answer = client.get(f"/api/v1/visits/{study_world.visit}/plan/sessions/{session['position']}/bundle")
        assert answer.status_code == 200, answer.text
        assert re.fullmatch(r'attachment; filename="(?:synthetic-)?P1-visit-\d+-session-\d+.zip"', answer.headers["content-disposition"])
        found[session["position"]] = answer.content
    return found


def files_of(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def words_of(content: bytes) -> set[str]:
    return set(re.findall(r"[a-z]+-?", content.decode().lower()))


@pytest.mark.hazard("H19")
def test_nobody_tells_from_a_blinded_bundle_what_it_runs(bundles: dict[int, bytes], db: Session) -> None:
    assert set(db.execute(text("select controller from plan_item")).scalars()) >= {"cdbs", "random"}
    opened = {position: files_of(content) for position, content in bundles.items()}
    assert len({tuple(files) for files in opened.values()}) == 1, "the same files"
    for name in next(iter(opened.values())):
        sizes = {len(files[name]) for files in opened.values()}
        assert max(sizes) - min(sizes) <= 40, f"{name} has one size but for letters, numbers and the last washout: {sizes}"
    common = []
    for files in opened.values():
        manifest = json.loads(files["manifest.json"])
        assert (manifest["policy_id"], manifest["schedule"], manifest["layers"]) == (None, None, [])
        assert manifest["slot"].pop("controller") == "blinded"
        for name in ("taken_by", "files", "sealed", "card", "policy_name", "slot", "approvals"):
            manifest.pop(name)
        common.append(manifest)
        for name in ("manifest.json", "sheet.html"):
            assert not words_of(files[name]) & set(TELLING), name
        zeros = np.frombuffer(files[SEALED], dtype=np.uint8) == 0
        assert 0.002 < zeros.mean() < 0.006, "neither its filling nor its text is seen: every byte is as frequent as any other"
    assert all(manifest == common[0] for manifest in common), "what the manifests say of limits and signal is the same"


def test_the_page_of_bundles_tells_the_limits_of_all_sessions_alike_until_the_key_is_opened(
    client: TestClient, study_world: Any, plan: dict[str, Any]
) -> None:
    def rows() -> list[str]:
        page = client.get(f"/visits/{study_world.visit}/bundles", headers={"Accept": "text/html"}).text
        found = page.split("<tbody>")[1].split("</tbody>")[0].split("<tr>")[1:]
        return [re.sub(r"<[^>]*>", " ", row) for row in found]

    sealed = rows()
    assert len(sealed) == len(plan["sessions"])
    assert all("0.5 to 3 mA, cDBS 3 mA" in row and "blinded" in row for row in sealed), sealed
    opened = client.post(f"/api/v1/visits/{study_world.visit}/plan/key", json={"reason": "the visit is over"})
    assert opened.status_code == 200, opened.text
    assert [("cDBS 3 mA" in row, "blinded" in row) for row in rows()] == [(True, False)] * len(sealed)
    assert any(re.search(r"\s3 mA, cDBS", row) for row in rows()), "a session of cDBS has one amplitude"


def test_the_page_of_a_policy_lists_the_bundles_of_a_sealed_plan_once_its_key_is_opened(
    client: TestClient, db: Session, study_world: Any, policies: list[int], bundles: dict[int, bytes]
) -> None:
    def taken() -> int:
        page = client.get(f"/participants/P1/policies/{policies[0]}/bundle", headers={"Accept": "text/html"})
        assert page.status_code == 200
        return page.text.count("cDBS 3 mA, ramp")

    assert db.scalar(text("select count(*) from bundle_release where policy_id = :id"), {"id": policies[0]}) == 1
    assert taken() == 0, "when it was taken, beside the other sessions' bundles, would tell which session it was"
    assert client.post(f"/api/v1/visits/{study_world.visit}/plan/key", json={"reason": "the visit is over"}).status_code == 200
    assert taken() == 1


def test_a_sealed_part_that_was_exchanged_or_cut_is_no_bundle(client: TestClient, bundles: dict[int, bytes]) -> None:
    key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(client.get("/api/v1/bundle-key").text.strip()))
    first, second = (files_of(bundles[p]) for p in (1, 2))
    outer = BundleManifest.from_bytes(first["manifest.json"])
    assert open_bundle(bundles[1], key).manifest.slot.position == 1  # type: ignore[union-attr]
    for sealed, words in ((second[SEALED], "is not the file that the manifest names"), (first[SEALED][:-1], "is not the file")):
        with pytest.raises(BundleError, match=words):
            open_bundle(packed(first | {SEALED: sealed}), key)
    # the signer could exchange it: it is checked against the manifest all the same
    other = dataclasses.replace(
        outer,
        sealed=json.loads(second["manifest.json"])["sealed"],
        files=outer.files | {SEALED: hashlib.sha256(second[SEALED]).hexdigest()},
    )
    with pytest.raises(BundleError, match="of another session"):
        open_bundle(packed(first | {SEALED: second[SEALED], "manifest.json": other.to_bytes()}))


def packed(files: dict[str, bytes]) -> bytes:
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return sink.getvalue()


@pytest.mark.synthetic
def test_a_blinded_day_runs_without_telling_and_comes_back_by_its_slots(
    client: TestClient, db: Session, study_world: Any, plan: dict[str, Any], bundles: dict[int, bytes], tmp_path: Path
) -> None:
    key = client.get("/api/v1/bundle-key").text.strip()
    items = {row.position: row for row in db.execute(text("select * from plan_item")).all()}
    heads, now = set(), datetime.now(UTC)
    if (now + timedelta(hours=1)).date() != now.date():
        pytest.skip("the sessions of this day would run into the next one, on which no bundle of today runs")
    for position, content in bundles.items():
        bundle, log = tmp_path / f"{position}.zip", tmp_path / f"{position}.csv"
        bundle.write_bytes(content)
        task = Task(log=log, key=key, ledger=tmp_path / "ledger", participant="P1", timed=20, begins=now + timedelta(minutes=10 * position))
        checked = lines(control(bundle, None, Wish(), Task(key=key, participant="P1")))
        assert "signature, files and test vectors are right" in checked, "how many files there are tells a network from a schedule"
        told = lines(control(bundle, f"simulated:P1:{position}", Wish(), task))
        assert "blinded" in told
        assert not set(reason_names(OF_THE_CONTROLLER)) & set(re.findall(r"\w+", told)), told
        assert not [w for w in (*TELLING, "mA", "energy", "decision in us", "battery") if re.search(rf"\b{w}\b", told)], told
        head, described, header, *rows = log.read_text().splitlines()
        assert not words_of(described.encode()) & {*TELLING, "latency", "design", "seed"}
        heads.add((head, len(described) - len(str(position)), header))
        for name in ("fraction", "requested_ma", "latency_us", "late_ms", "hold", "log_density"):
            assert {row.split(",")[header.split(",").index(name)] for row in rows} == {""}, name
        given = {word for row in rows for word in row.split(",")[header.split(",").index("reasons")].split()}
        assert not given & set(reason_names(OF_THE_CONTROLLER)), given
        sent = client.post("/api/v1/uploads", data={"participant": "P1"}, files={"file": ("log.csv", log.read_bytes())})
        assert sent.status_code == 201, sent.text
    assert len(heads) == 1, "one log looks like another but for its amplitudes"
    path = f"/api/v1/visits/{study_world.visit}/slots"
    done = client.post(f"{path}/confirm", json={})
    assert done.status_code == 200, done.text
    assert client.post(f"/api/v1/visits/{study_world.visit}/plan/key", json={"reason": "the visit is over"}).status_code == 200
    for row in client.get(path).json()["rows"]:
        item = items[row["position"]]
        assert (row["confirmed"], row["deviations"]) == (True, [])
        found = db.execute(text("select controller, policy_id from session where id = :id"), {"id": row["session_id"]}).one()
        assert tuple(found) == (item.controller, item.policy_id)
        conditions = client.get(f"/api/v1/sessions/{row['session_id']}/conditions").json()
        assert (conditions["min_ma"], conditions["max_ma"]) == (item.min_ma, item.max_ma), "the limits of the slot, not the common ones"
        if item.controller == "random":
            drawn = [(h["start"], h["steps"], h["log_density"]) for h in item.design["holds"]]
            kept = [(h["start"], h["steps"], h["log_density"]) for h in conditions["design_parameters"]["holds"]]
            np.testing.assert_allclose(kept, drawn)
            assert (conditions["design"], conditions["seed"]) == (item.design["design"], item.design["seed"])


def test_the_bundles_own_runner_runs_a_blinded_session_and_refuses_it_a_second_time(
    client: TestClient, bundles: dict[int, bytes], tmp_path: Path
) -> None:
    key = client.get("/api/v1/bundle-key").text.strip()
    with zipfile.ZipFile(io.BytesIO(bundles[1])) as archive:
        archive.extractall(tmp_path)
    call = [sys.executable, "-m", "controller", f"--key={key}", "--time=20", "--run", "--log=log.csv", f"--ledger={tmp_path / 'ledger'}"]
    m = json.loads((tmp_path / "manifest.json").read_bytes())
    hello = f"hello 1 P1 - {m['beta_unit']} {m['beta_source']} {1000 * m['period_s']:g}\n"
    first = subprocess.Popen(
        call, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1
    )
    assert first.stdin is not None
    first.stdin.write(hello)
    began, seq = time.monotonic(), 0
    while not any("decided" in run.read_text() for run in tmp_path.glob("ledger/*.run")) and time.monotonic() < began + 60:
        if (passed := time.monotonic() - began) >= m["period_s"] * (seq + 1):
            first.stdin.write(f"beta {seq} {1000 * passed:.0f} {1.4 + 0.1 * (seq % 3)} {m['beta_unit']} {m['beta_source']}\n")
            seq += 1
        time.sleep(0.05)
    out, said = first.communicate("stop\n", timeout=120)
    assert first.returncode == 0, said
    assert "test vectors agree" in said
    assert "worst difference" not in said, "0 of a fraction is that of a schedule"
    assert "blinded: what a decision takes stands masked in its log" in out
    again = subprocess.run([*call[:-2], "--log=b.csv", call[-1]], cwd=tmp_path, input=hello, capture_output=True, text=True, check=False)
    assert (again.returncode, "a slot runs once" in again.stderr) == (1, True)


@pytest.mark.hazard("H20")
def test_a_withdrawn_policy_and_another_participant_are_refused_to_a_blinded_bundle(
    client: TestClient, db: Session, bundles: dict[int, bytes], policies: list[int], tmp_path: Path
) -> None:
    key, bundle = client.get("/api/v1/bundle-key").text.strip(), tmp_path / "b.zip"
    position = db.execute(text("select position from plan_item where policy_id = :id"), {"id": policies[0]}).scalar_one()
    bundle.write_bytes(bundles[position])
    with pytest.raises(Invalid, match="of participant P1, not P2"):
        control(bundle, "simulated:P1", Wish(), Task(key=key, participant="P2", log=tmp_path / "a.csv", ledger=tmp_path / "l"))
    tomorrow = Task(key=key, log=tmp_path / "a.csv", ledger=tmp_path / "l", begins=datetime(2099, 1, 1, 9, tzinfo=UTC))
    with pytest.raises(Invalid, match="expired that night"):
        control(bundle, "simulated:P1", Wish(), tomorrow)
    assert client.patch(f"/api/v1/policies/{policies[0]}", json={"retired_reason": "a fault"}).status_code in (200, 204)
    listed = tmp_path / "withdrawn.txt"
    listed.write_bytes(client.get("/api/v1/bundle-withdrawals").content)
    with pytest.raises(Invalid, match="was withdrawn") as refused:
        control(bundle, "simulated:P1", Wish(), Task(key=key, log=tmp_path / "a.csv", ledger=tmp_path / "l", withdrawn=listed))
    assert f"policy {policies[0]}" not in str(refused.value), "a refusal does not tell whose session it was"


def test_the_audit_trail_gives_no_limits_of_a_sealed_plans_bundles(
    client: TestClient, db: Session, study_world: Any, plan: dict[str, Any], bundles: dict[int, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    def trail() -> str:
        paths = ("/audit?limit=100", "/audit?entity=bundle_release", "/audit?entity=stored_file&limit=100")
        return " ".join(client.get(path, headers={"Accept": "text/html"}).text for path in paths)

    kept = db.scalars(text("select reason from audit_event where entity = 'bundle_release' order by id")).all()
    assert kept == [f"session bundle of a blinded plan: session {n} of plan {plan['id']}, P1" for n in bundles]
    old = "controller bundle of P1, policy 7: 0.5 to 3 mA"  # as earlier versions wrote it
    monkeypatch.setattr("app.planning.plans.wording.release_reason", lambda manifest: old)
    stored.remove(db.scalar(text("select sha256 from bundle_release order by id limit 1")))  # so that the file is stored again
    assert client.get(f"/api/v1/visits/{study_world.visit}/plan/sessions/1/bundle").status_code == 200
    sealed = trail()
    assert "took the bundle of a session of a blinded plan" in sealed
    assert not re.findall(rf".{{0,200}}{old}", sealed)
    assert client.post(f"/api/v1/visits/{study_world.visit}/plan/key", json={"reason": "the visit is over"}).status_code == 200
    assert trail().count(old) == 3, "on the page of all, and with the releases and the files"
