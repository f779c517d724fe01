"""Dose shapes: evidences stored with every evaluation, taken by those who ask for them and may have them, and what the page says."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.estimates import dose_shapes
from app.evaluation.estimates.compute import evaluate_method
from app.evaluation.wording import shape_pooling
from app.platform.jobs import StepReport
from app.study.repository import participant_by_code
from app.tables.evaluations import Evaluation
from ml.ope.outcomes.minutes import SHAPES
from ml.ope.outcomes.pooling import pool
from ml.ope.posterior.estimator import build
from ml.policies.policy import ConstantPolicy
from tests.app.evaluation.estimates.test_compute import buffer_of, call, sessions
from tests.app.evaluations import judged

K = len(SHAPES)
SETTINGS = "/api/v1/participants/P1/settings"


def said(shape: int) -> dict[str, Any]:
    """Build what an evaluation stores of a participant of whom one shape of the grasp is known."""
    return {"shapes": dose_shapes.KNOWN, "evidence": {"grasp": [30.0 * (k == shape) for k in range(K)]}, "pooling": {}}


def proof(*shapes: int) -> dict[str, Any]:
    """Pool the grasp of participants whose shapes are known, the first one's own; return the proof."""
    first, *others = (said(k)["evidence"] for k in shapes)
    return pool(first, others).proofs["grasp"].to_json()


def enrol(client: TestClient, code: str, site: str = "main") -> None:
    assert client.post("/api/v1/participants", json={"code": code, "site": site}).status_code == 201


def store(db: Session, code: str, like: int, told: dict[str, Any]) -> int:
    """Store an evaluation of a participant, in all but its diagnostics like another one."""
    other = db.get_one(Evaluation, like)
    copied = {c.key: getattr(other, c.key) for c in Evaluation.__table__.columns if c.key not in ("id", "job_id", "created_at")}
    owner = participant_by_code(db, code, SYSTEM).id
    row = Evaluation(**copied | {"participant_id": owner, "diagnostics": {dose_shapes.STORED: told}})
    db.add(row)
    db.commit()
    return row.id


def asked(db: Session) -> dict[str, Any] | None:
    db.expire_all()
    participant = participant_by_code(db, "P1", SYSTEM)
    return dose_shapes.of_others(db, participant, participant.current_settings)


def test_the_evidences_of_the_newest_evaluations_of_the_site_are_taken_where_the_settings_ask_for_them(
    client: TestClient, judge: Callable[..., int], policies: list[int], db: Session
) -> None:
    own = judge({policies[0]: judged(3.0)})
    store(db, "P1", own, said(0))
    assert client.post("/api/v1/studies/main/sites", json={"code": "south", "name": "South"}).status_code == 201
    for code, site in (("P2", "main"), ("P3", "main"), ("P4", "main"), ("P5", "south"), ("P6", "main")):
        enrol(client, code, site)
    store(db, "P2", own, said(1))
    newest = store(db, "P2", own, said(2))
    kept = store(db, "P3", own, said(3))
    store(db, "P4", own, said(4))
    store(db, "P5", own, said(5))
    store(db, "P6", own, said(6) | {"shapes": dose_shapes.KNOWN[:-1]})
    gone = client.patch("/api/v1/participants/P4", json={"status": "withdrawn", "reason": "moved away"})
    assert gone.status_code == 200, gone.text
    assert client.get(SETTINGS).json()[0]["pool_shapes"] is False
    assert asked(db) is None
    changed = client.put(SETTINGS, json={"settings": {"pool_shapes": True}, "reason": "four alike"})
    assert changed.status_code in (200, 201), changed.text
    assert asked(db) == {"evidence": [said(2)["evidence"], said(3)["evidence"]], "evaluations": [newest, kept]}
    # a newest evaluation that says nothing of shapes does not fall back on one before it
    store(db, "P3", own, {})
    assert asked(db) == {"evidence": [said(2)["evidence"]], "evaluations": [newest]}


def test_the_posterior_gives_its_evidences_and_pools_those_of_others_where_the_proof_holds(db: Session, tmp_path: Path) -> None:
    params, silent = call(db, buffer_of(sessions()), method="posterior"), StepReport(lambda _: None)
    alone = json.loads(json.dumps(evaluate_method(params, tmp_path, silent)))
    told = alone[dose_shapes.STORED]
    assert told["shapes"] == [list(shape) for shape in SHAPES]
    assert {o: len(v) for o, v in told["evidence"].items()} == {"tremor": K, "grasp": K, "rating": K}
    assert all(max(v) == 0 for v in told["evidence"].values())
    assert told["pooling"] == {}
    assert "shape_pooling" not in alone["estimates"]["7"]["details"]

    others = [said(8)["evidence"]] * 4
    pooled = json.loads(json.dumps(evaluate_method(params | {"others": others}, tmp_path, silent)))
    found = pooled[dose_shapes.STORED]
    assert found["evidence"] == told["evidence"]
    assert {o: (p["participants"], p["used"]) for o, p in found["pooling"].items()} == {
        "tremor": (1, False), "grasp": (5, True), "rating": (1, False)
    }  # fmt: skip
    assert pooled["estimates"]["7"]["details"]["shape_pooling"] == found["pooling"]
    direct = build("posterior", 0, "demo").with_others(others).fit(buffer_of(sessions())).evaluate({"7": ConstantPolicy(0.6)}, 50)
    assert pooled["estimates"]["7"]["value"] == pytest.approx(direct["7"].value, abs=1e-6)
    assert pooled["estimates"]["7"]["predicted"]["grasp_hz"] != alone["estimates"]["7"]["predicted"]["grasp_hz"]

    refused = evaluate_method(params | {"others": others[:2]}, tmp_path, silent)
    for name in ("value", "low", "high", "predicted"):
        assert refused["estimates"]["7"][name] == alone["estimates"]["7"][name]


def test_a_site_of_one_pools_nothing_and_says_why() -> None:
    assert shape_pooling("grasp", proof(2)) == (
        "grasp: not pooled, because 0 other participants of the site have an evaluation that tells of it, and 3 are needed"
    )
    expected = np.log(K * 5 / (K + 4))
    assert shape_pooling("grasp", proof(2, 2, 2, 2, 2) | {"own_gain": -0.5}) == (
        f"grasp: dose shapes pooled with 4 other participants: gain +{expected:.2f} ± 0.00 nats for whoever is left out, "
        "\N{MINUS SIGN}0.50 for this participant"
    )
    apart = shape_pooling("grasp", proof(0, 1, 2, 3, 4))
    assert apart.startswith(
        "grasp: not pooled with 4 other participants, because it does not help whoever is left out: gain \N{MINUS SIGN}"
    )


def test_the_ranking_says_in_the_fold_for_engineers_what_was_pooled(
    client: TestClient, judge: Callable[..., int], policies: list[int]
) -> None:
    judge({policies[0]: judged(3.0)}, shapes=said(2))
    assert "Dose shapes of the outcomes" not in client.get("/participants/P1/ranking").text
    told = proof(2, 2, 2, 2, 2) | {"own_gain": 0.25}
    judge({policies[0]: judged(3.0)}, shapes=said(2) | {"pooling": {"grasp": told}})
    page = client.get("/participants/P1/ranking").text
    assert "grasp: dose shapes pooled with 4 other participants: gain +1.24 ± 0.00 nats for whoever is left out" in page
    assert page.index("Dose shapes of the outcomes") > page.index("<details")
