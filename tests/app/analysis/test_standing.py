"""The standing of a policy: one sentence from its harms, its sessions and its prediction, the same on every page."""

from __future__ import annotations

import csv
import html
import io
import itertools
import zipfile
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from fastapi.testclient import TestClient
from pypdf import PdfReader

from app.analysis.primary_verdict import VerdictResult, policy_verdicts
from app.analysis.standing import Standing
from app.evaluation.ranking.decisions import Decided
from app.study.blinding import Arm
from ml.ope import Flag
from ml.qoc import failed_qoc
from tests.app.analysis.primary.test_what_cannot_be_told import CDBS, LOCKED, RL, varied
from tests.app.evaluations import judge as judge
from tests.app.evaluations import judged
from tests.app.evaluations import policies as policies
from tests.app.words import flat

Upload = Callable[..., int]


def measurement(visits: int, **fixed: float) -> VerdictResult:
    """Return the verdict on policy 7, which drove every session but those of cDBS."""
    sessions = [replace(s, arm=Arm(RL, 7)) if s.controller is not CDBS else s for s in varied(visits, **fixed)]
    return policy_verdicts(sessions, LOCKED, failed_qoc([]))[7]


HARMS: dict[str, tuple[Flag, ...]] = {
    "": (),
    "Held back: serious adverse event, not cleared by a clinician.": (Flag("adverse_event"),),
    "Held back: 1 session stopped for the participant's sake, not cleared by a clinician.": (Flag("stopped", 1.0, None, "stops"),),
}
MEASURED: dict[str, Callable[[], VerdictResult | None]] = {
    "Not tested.": lambda: None,
    "Measured, exploratory: Inconclusive over 1 visit: net-7 is not shown to be non-inferior": lambda: measurement(1),
    "Measured, exploratory: net-7 is non-inferior to cDBS on grasp, rating and tremor and saves": lambda: measurement(6),
}
PREDICTED: dict[str, Decided | None] = {
    "Not ranked.": None,
    "Predicted: test.": Decided("test", ()),
    "Predicted: cannot tell (hardly any session came near what it does).": Decided("cannot_tell", (Flag("few_near_sessions", 1.0, 2.0),)),
    "Predicted: not advised (nearly off 40 % of the time).": Decided("cannot_tell", (Flag("nearly_off", 0.4, 0.2, "share"),)),
}


@pytest.mark.parametrize(("harm", "result", "prediction"), itertools.product(HARMS, MEASURED, PREDICTED))
def test_a_standing_says_harms_then_measurement_then_prediction(harm: str, result: str, prediction: str) -> None:
    verdict, predicted = MEASURED[result](), PREDICTED[prediction]
    text = Standing("net-7", HARMS[harm], 0, verdict, predicted).sentence
    places = [text.find(part) for part in (harm, result, prediction)]
    assert -1 not in places, text
    assert places == sorted(places), text
    assert ("Held back" in text) == bool(harm)
    settled = "saves" in result and predicted is not None
    assert ("The measurement counts before the prediction." in text) == settled, text


def test_a_policys_verdict_rests_on_its_own_sessions_alone() -> None:
    sessions = [replace(s, arm=Arm(RL, 7 if s.visit < 4 else 8)) if s.controller is not CDBS else s for s in varied(6)]
    found = policy_verdicts(sessions, LOCKED, failed_qoc([]))
    assert [(i, v.visits, v.confirmatory) for i, v in found.items()] == [(7, (1, 2, 3), False), (8, (4, 5, 6), False)]


def shown_everywhere(client: TestClient, policy: int, visit: int) -> str:
    """Return the sentence of a policy, after every page, the interface and both exports were found to have it."""
    found = client.get("/api/v1/participants/P1/analyses/primary").json()["standings"]
    text = next(s["sentence"] for s in found if s["policy_id"] == policy)
    tested = "Not tested." not in text or "Held back" in text
    pages = (f"/policies/{policy}", *(("", "/analyses", "/ranking") if tested else ()))
    for path in (*(f"/participants/P1{page}" for page in pages), f"/visits/{visit}/plan"):
        page = html.unescape(flat(client.get(path, headers={"Accept": "text/html"}).text))
        assert text.partition(". ")[2] in page, path
    sheet = PdfReader(io.BytesIO(client.get(f"/api/v1/visits/{visit}/plan.pdf").content))
    assert "".join(text.split()) in "".join("".join(page.extract_text() for page in sheet.pages).split())
    return str(text)


def test_every_page_that_shows_a_policy_gives_the_same_standing(
    client: TestClient, policies: list[int], judge: Callable[..., int], upload: Upload
) -> None:
    a = policies[0]
    judge({a: judged(50.0)})
    visit = client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2099-11-22"}).json()["id"]
    assert client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": [a], "min_ma": 0.5}).status_code == 201
    assert shown_everywhere(client, a, visit) == "p0. Not tested. Predicted: test."
    session = upload("rl", level=0.6, policy=a)
    assert "p0. Measured, exploratory: Inconclusive over 1 visit: p0 is" in shown_everywhere(client, a, visit)
    stop: dict[str, Any] = {"stopped_reason": "dizzy", "reason": "notes"}
    assert client.patch(f"/api/v1/sessions/{session}", json=stop).status_code == 200
    assert "p0. Held back: 1 session stopped for the participant's sake" in shown_everywhere(client, a, visit)
    rows = client.get("/participants/P1/analyses.csv").text.splitlines()
    assert rows[0].endswith(",standing")
    assert "Held back" in rows[-1]


def test_the_ranking_by_rest_its_table_and_the_data_package_have_the_sentence_of_the_pages(
    client: TestClient, policies: list[int], judge: Callable[..., int], upload: Upload
) -> None:
    judge({number: judged(40.0 + number) for number in policies})
    upload("rl", level=0.6, policy=policies[0])
    listed = client.get("/api/v1/participants/P1/analyses/primary").json()["standings"]
    due = {s["policy_id"]: s["sentence"] for s in listed}
    assert due.keys() >= set(policies)
    ranking = client.get("/api/v1/participants/P1/ranking").json()
    assert {p["policy_id"]: p["standing"] for p in ranking["policies"]} == {
        p["policy_id"]: due[p["policy_id"]] for p in ranking["policies"]
    }
    table = csv.DictReader(io.StringIO(client.get("/api/v1/participants/P1/ranking?format=csv").text))
    assert {int(r["policy_id"]): r["standing"] for r in table if not r["reference"]}.items() <= due.items()
    package = zipfile.ZipFile(io.BytesIO(client.get("/participants/P1/export.zip").content))
    rows = csv.DictReader(io.StringIO(package.read("P1/policies.csv").decode()))
    assert {int(r["policy_id"]): r["standing"] for r in rows if r["standing"]} == due


def test_a_blinded_assessor_is_told_no_standing(client_as: Callable[[str], TestClient], policies: list[int], upload: Upload) -> None:
    upload("rl", level=0.6, policy=policies[0])
    assert client_as("blinded_assessor").get("/api/v1/participants/P1/analyses/primary").json()["standings"] == []
