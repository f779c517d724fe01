"""An outcome is one record: what is added here appears in forms, tables, interface, margins, package and primary analysis at once."""

from __future__ import annotations

import csv
import io
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, text
from sqlalchemy.orm import Session

from app.platform.upkeep.migrate import migrate, newest_revision, revision
from app.tables.audit import Signature
from tests.app.words import flat

ROOT = Path(__file__).resolve().parents[3]


def run(client: TestClient, further: str) -> dict[str, Any]:
    """Run the study whose outcomes a file defines, in a process of its own."""
    command = [sys.executable, "-m", "tests.app.analysis.new_outcome", client.headers["Authorization"].split()[1], further]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr[-4000:]
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_a_new_outcome_goes_from_the_entry_form_to_the_primary_analysis(client: TestClient, db: Session) -> None:
    enrol = {"code": "P0", "settings": {"xi_beta": 1.0, "cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"}}
    assert client.post("/api/v1/participants", json=enrol).status_code == 201  # before there was such an outcome
    seen = run(client, "")
    assert 'name="balance_score"' in seen["form"]
    assert "Berg balance scale." in seen["form"]
    assert seen["entered"][0] in (200, 303), seen["entered"]
    value = seen["scores"][0][1]
    assert seen["stored"]["balance_score"] == value
    assert seen["refused"][0] == 422
    assert "balance_score" in seen["refused"][1]
    assert seen["document"]["properties"]["balance_score"]["anyOf"][0]["maximum"] == 56
    assert "Balance" in seen["visit"]
    assert f">{value}</td>" in seen["visit"]
    status, changed, page = seen["margins"]
    assert (status, changed["balance_score_margin"], changed["version"]) == (200, 3, 2)
    assert "Balance score lower by" in page

    (verdict,) = seen["primary"]["verdicts"]
    outcomes = {o["outcome"]: o for o in verdict["outcomes"]}
    assert list(outcomes) == ["grasp", "rating", "tremor", "balance_score", "mds_updrs_iii"]
    # by visit: 2 and 1 points less than cDBS in two pairs; the stopped session of visit 4 counts as the worst of all sessions instead
    scores = [score for _, score in seen["scores"]]
    by_visit = [(scores[4 * v + 1] + scores[4 * v + 3] - scores[4 * v] - scores[4 * v + 2]) / 2 for v in range(4)]
    by_visit[3] += (min(scores) - scores[15]) / 2
    assert outcomes["balance_score"]["estimate"] == pytest.approx(sum(by_visit) / 4)
    assert (outcomes["balance_score"]["margin"], outcomes["balance_score"]["failures"]) == (4.0, 1)
    comparisons = {c["metric"]: c for r in seen["primary"]["results"] if r["controller"] == "rl" for c in r["comparisons"]}
    assert (comparisons["balance_score"]["title"], comparisons["balance_score"]["unit"]) == ("Balance score", "of 56")
    assert re.search(r"Balance score</a><span class=\"unit\">points</span></td><td class=\"num\">3\.00<", flat(seen["page"]))
    assert [m["metric"] for m in seen["five"]["metrics"]][-2:] == ["balance_score", "mds_updrs_iii"]

    tables = {name: list(csv.DictReader(io.StringIO(text))) for name, text in seen["tables"].items()}
    assert [row["balance_score"] for row in tables["sessions"]] == [str(score) for score in scores]
    assert [row["outcome"] for row in tables["outcomes"]] == ["grasp", "rating", "tremor", "balance_score", "mds_updrs_iii"]
    assert [float(row["balance_score_margin"]) for row in tables["margins"]] == [4.0, 3.0]
    assert seen["recomputed"][0] == 0, seen["recomputed"][1]
    assert "all agree" in seen["recomputed"][1]
    # what was stated before has the margin of the file, and nothing counts as changed past the trail
    assert (seen["earlier"]["balance_score_margin"], seen["earlier"]["mds_updrs_iii_margin"]) == (4.0, 5.0)
    checks = {name: (ok, detail) for name, ok, detail in seen["checks"]}
    assert checks["database"][0], checks["database"]
    assert checks["audit trail"][0], checks["audit trail"]

    # a process without the file is refused, and loses nothing
    assert revision(db) != newest_revision()
    assert client.get("/readyz").status_code == 503
    with pytest.raises(RuntimeError, match=r"1 value of `balance_score_margin`, which is no longer defined: put its definition back"):
        migrate()
    assert db.scalar(text("select count(balance_score) from qoc")) == 16


def test_a_study_reaches_a_verdict_by_the_outcomes_that_it_judges(client: TestClient, db: Session) -> None:
    seen = run(client, "judged: [mds_updrs_iii]\n")
    (verdict,) = seen["primary"]["verdicts"]
    (judged,) = verdict["outcomes"]
    # above 0 is better: RL has two points more than the cDBS sessions of its visit, within the margin of 5
    assert (judged["outcome"], judged["margin"], judged["estimate"]) == ("mds_updrs_iii", 5.0, pytest.approx(-2.0))
    assert verdict["verdict"] == "non_inferior_and_saving"
    assert "non-inferior to cDBS on MDS-UPDRS part III and saves" in verdict["sentence"]
    assert "non-inferior to cDBS on MDS-UPDRS part III and saves" in flat(seen["page"])
    assert seen["locked"][0] == 201, seen["locked"]
    (signed,) = db.scalars(select(Signature.content)).all()
    assert signed["judged"] == ["mds_updrs_iii"]
