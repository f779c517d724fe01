"""Coverage by the data comes before the estimates: stored with the evaluation, worded; a failed check counts for every method."""

from __future__ import annotations

import csv
import html
import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation import wording
from app.evaluation.estimates.compute import check_coverage
from app.evaluation.estimates.coverage import CHECKS, VERDICTS, shown_limit, shown_value
from app.evaluation.estimates.service import store_evaluation
from app.evaluation.schemas import CheckOut
from app.learning.policies import constant_onnx, ensure_baselines
from app.learning.snapshots import collect, take_snapshot
from app.learning.trajectories import read_buffer
from app.overview.package import export_participant
from app.platform import files
from app.platform.jobs import StepReport
from app.study.repository import participant_by_code
from app.tables.evaluations import Evaluation
from ml.ope.flags import Flag
from ml.ope.support.coverage import AmplitudeSupport, flags_of
from ml.ope.support.diagnostics import diagnose
from ml.policies.onnx_policy import OnnxPolicy
from tests.app.evaluation.estimates.test_compute import buffer_of, call, sessions
from tests.app.evaluations import estimate, judged
from tests.ml.ope.posterior.draws import cdbs as held

RANKING = "/api/v1/participants/P1/ranking"
REFUSAL = Flag.of("outside_range", 0.4, 0.2, "share", refuses=True, low=0.3, high=1.0)
REFUSED = "not supported by the data: in 40 % of steps the policy leaves the logged amplitudes (0.30 to 1.00)"
NOTE = Flag("unseen_dose", 0.7, 0.05, "share")
NOTED = "in 70 % of steps the policy's average amplitude over the last minute is one that no session held"
FEW = Flag.of("weights_need_sessions", 1.23, 10.0, "sessions", sessions=4.0)


def checked(*, failing: tuple[Flag, ...] = (), notes: tuple[Flag, ...] = ()) -> dict[str, Any]:
    """Build what `Diagnostics.to_json` gives of one policy."""
    values = {"outside_range": (0.4 if failing else 0.0, 0.2, "refused" if failing else "passed"), "thin": (0.1, 0.2, "noted")}
    values |= {"far": (0.004, 0.2, "passed"), "below_random_bound": (None, 0.05, "told")}
    values |= {"unseen_dose": (0.7 if notes else 0.0, 0.05, "noted" if notes else "passed"), "distance": (0.314, None, "told")}
    values |= {"effective_sessions": (1.23, 10.0, "weights"), "largest_weight_share": (0.9, None, "told")}
    values |= {"horizon_of_ten": (4.0, 60.0, "weights")}
    checks = [
        {"name": n, "value": v, "limit": limit, "at_least": n in ("effective_sessions", "horizon_of_ten"), "verdict": verdict}
        for n, (v, limit, verdict) in values.items()
    ]
    flags = {"failing": failing, "notes": notes, "weights_failing": (FEW,)}
    stored = {name: [flag.to_json() for flag in found] for name, found in flags.items()}
    return {"supported": not failing, "sessions": 4, "checks": checks, "horizon_steps": 60} | stored


@pytest.fixture
def store(db: Session, policies: list[int]) -> Callable[..., Evaluation]:
    """Function that stores an evaluation by the posterior and two methods, with coverage; cDBS is at 45, the candidates at 60, 99 and
    50.
    """

    def make(outcome: Callable[[list[int]], dict[str, Any]] | dict[str, Any] | None) -> Evaluation:
        participant = participant_by_code(db, "P1", SYSTEM)
        snapshot = take_snapshot(db, participant, SYSTEM)
        made = ensure_baselines(db, participant, snapshot, collect(db, participant).buffer, "test")
        cdbs = next(p.id for p in made if p.config.get("amplitude") == 1.0)
        values = dict(zip(policies, (60.0, 99.0, 50.0), strict=True)) | {cdbs: 45.0}
        results = {m: {"estimates": {str(i): estimate(m, v) for i, v in values.items()}} for m in ("dlsm", "linear")}
        reference = held(value=45.0).to_json()
        results["posterior"] = {"estimates": {str(i): reference if i == cdbs else judged(v) for i, v in values.items()}}
        row = store_evaluation(
            db, job_id=None, created_by="test", snapshot=snapshot, horizon_steps=60, candidates=policies, results=results, config={},
            coverage=outcome(list(values)) if callable(outcome) else outcome,
        )  # fmt: skip
        db.commit()
        return row

    return make


def test_the_compute_step_gives_what_the_science_finds(db: Session, tmp_path: Path) -> None:
    params = call(db, buffer_of(sessions()))
    off = files.store(db, constant_onnx(0.0, 10)).sha256
    params["policies"].append({"id": 8, "sha256": off})
    told: list[dict[str, Any]] = []
    found = json.loads(json.dumps(check_coverage(params, tmp_path, StepReport(told.append, interval_s=0.0))))["policies"]
    buffer = read_buffer(params["snapshot_sha256"])
    held = {"7": OnnxPolicy(constant_onnx(0.6, 10), 10), "8": OnnxPolicy(constant_onnx(0.0, 10), 10)}
    for policy_id, direct in diagnose(buffer, held, 50).items():
        shown = {c["name"]: c["value"] for c in found[policy_id]["checks"]}
        assert shown["effective_sessions"] == pytest.approx(direct.effective_sessions)
        assert shown["far"] == pytest.approx(direct.far)
        assert found[policy_id]["failing"] == [flag.to_json() for flag in direct.failing]
    assert {c["name"] for c in found["7"]["checks"]} == set(CHECKS)
    assert any("checking what the data cover" in (m.get("message") or "") for m in told)


def test_data_that_cannot_be_checked_say_why(db: Session, tmp_path: Path) -> None:
    result = check_coverage(call(db, buffer_of(sessions(lead=float("nan")))), tmp_path, StepReport(lambda _: None))
    assert "no session has a complete window of beta before its first step" in result["failed"]


def test_a_refused_policy_is_unsupported_by_every_method_and_ranks_after_all_others(
    client: TestClient, policies: list[int], store: Callable[..., Evaluation]
) -> None:
    a, b, c = policies
    row = store(lambda ids: {"policies": {str(i): checked(failing=(REFUSAL,) if i == b else ()) for i in ids}})
    assert {(e.method, e.policy_id) for e in row.estimates if not e.supported} == {("dlsm", b), ("linear", b), ("posterior", b)}
    for method in ("dlsm", "linear", "posterior"):
        body = client.get(RANKING, params={"method": method}).json()
        assert [(p["policy_id"], p["supported"]) for p in body["policies"]] == [(a, True), (c, True), (b, False)]
        refused = body["policies"][2]
        assert refused["decision"] == "test_with_care", "promising, and only down to the lowest dose that two sessions held"
        assert REFUSED in refused["decision_reason"]
        assert {"code": "outside_range", "value": 0.4, "limit": 0.2, "unit": "share"} in refused["decision_reasons"]
        assert refused["flags"][0]["text"] == REFUSED
        assert refused["probability_best"] == 0.0
        assert (refused["coverage"]["supported"], [f["text"] for f in refused["coverage"]["failing"]]) == (False, [REFUSED])
    assert [p["policy_id"] for p in client.get(RANKING, params={"supported": "true"}).json()["policies"]] == [a, c]


def test_a_note_is_told_and_refuses_nothing(client: TestClient, policies: list[int], store: Callable[..., Evaluation]) -> None:
    a, b, _ = policies
    store(lambda ids: {"policies": {str(i): checked(notes=(NOTE,) if i == b else ()) for i in ids}})
    ranked = client.get(RANKING).json()["policies"]
    assert [(p["policy_id"], p["supported"], p["decision"]) for p in ranked[:2]] == [(b, True, "test"), (a, True, "test")]
    assert ([f["code"] for f in ranked[0]["flags"]], ranked[1]["flags"]) == (["unseen_dose"], [])
    assert NOTED in html.unescape(client.get("/participants/P1/ranking").text)


def test_the_page_tells_the_checks_before_any_estimate(client: TestClient, policies: list[int], store: Callable[..., Evaluation]) -> None:
    store(lambda ids: {"policies": {str(i): checked(failing=(REFUSAL,) if i == policies[1] else (), notes=(NOTE,)) for i in ids}})
    page = html.unescape(client.get("/participants/P1/ranking").text)
    block = page[page.index('id="coverage"') : page.index('id="forest"')]
    for text in ("What the data can say", "Outside the logged amplitudes", "at most 20 %", "40 %", "failed", "do not support it", "to know",
                 "1.2 of 4", "at least 10", "4 of 60", "< 1 %", "not known", REFUSED, "Dose that no session held", "0.31"):  # fmt: skip
        assert text in block, text
    assert block.count("do not support it") == 1


def test_the_csv_has_every_check_of_the_policy(client: TestClient, policies: list[int], store: Callable[..., Evaluation]) -> None:
    store(lambda ids: {"policies": {str(i): checked(failing=(REFUSAL,)) for i in ids if i == policies[1]}})
    rows = list(csv.DictReader(io.StringIO(client.get(RANKING, params={"format": "csv"}).text)))
    refused = next(r for r in rows if r["policy_id"] == str(policies[1]))
    assert (refused["coverage_supported"], refused["coverage_failing"]) == ("False", REFUSED)
    assert {name: refused[f"coverage_{name}"] for name in ("outside_range", "effective_sessions", "horizon_of_ten")} == {
        "outside_range": "0.4", "effective_sessions": "1.23", "horizon_of_ten": "4.0"
    }  # fmt: skip
    assert all(f"coverage_{name}" in refused for name in CHECKS)
    other = next(r for r in rows if r["policy_id"] == str(policies[0]))
    assert (other["coverage_supported"], other["coverage_far"]) == ("", "")


def test_the_participants_record_has_a_row_for_every_check(policies: list[int], store: Callable[..., Evaluation], db: Session) -> None:
    row = store(lambda ids: {"policies": {str(i): checked(failing=(REFUSAL,)) for i in ids if i == policies[1]}})
    record = export_participant(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    with zipfile.ZipFile(io.BytesIO(record)) as archive:
        rows = list(csv.DictReader(io.StringIO(archive.read("P1/coverage.csv").decode())))
    assert {(r["evaluation_id"], r["policy_id"], r["supported"]) for r in rows} == {(str(row.id), str(policies[1]), "false")}
    found = {r["check"]: (r["value"], r["limit"], r["limit_is"], r["verdict"]) for r in rows}
    assert set(found) == set(CHECKS)
    assert found["outside_range"] == ("0.4", "0.2", "greatest", "refused")
    assert found["effective_sessions"] == ("1.23", "10.0", "least", "weights")
    assert found["below_random_bound"] == ("", "0.05", "greatest", "told")


def test_where_nothing_could_be_checked_no_candidate_is_proposed(
    client: TestClient, policies: list[int], store: Callable[..., Evaluation]
) -> None:
    store({"failed": "no session has a complete window"})
    body = client.get(RANKING).json()
    assert body["coverage_failed"] == "no session has a complete window"
    assert {p["decision"] for p in body["policies"]} == {"cannot_tell"}
    assert "could not be checked: no session has a complete window" in body["policies"][0]["decision_reason"]
    page = client.get("/participants/P1/ranking").text
    assert "What the data cover could not be checked" in page
    assert "No session has a complete window. No candidate is proposed for a test" in page


def test_an_evaluation_from_before_the_checks_still_shows(
    client: TestClient, policies: list[int], store: Callable[..., Evaluation], db: Session
) -> None:
    row = store(None)
    row.diagnostics = {name: value for name, value in row.diagnostics.items() if name != "coverage"}
    db.commit()
    body = client.get(RANKING).json()
    assert [p["coverage"] for p in body["policies"]] == [None] * 3
    assert (body["coverage_failed"], body["policies"][0]["decision"]) == (None, "test")
    assert "This evaluation was made before these checks were stored" in client.get("/participants/P1/ranking").text


def test_what_a_method_saw_in_its_simulated_sessions_is_told_apart_from_the_logged_steps() -> None:
    support = AmplitudeSupport(buffer_of(sessions()))
    logged, simulated = support.look(np.full(100, 0.6)), support.look(np.r_[np.full(70, 0.6), np.full(30, 0.15)])
    assert [wording.sentence(flag) for flag in flags_of(logged, simulated)] == [
        "no closed loop: about 60 % of the cDBS amplitude whatever beta does",
        "not supported by the data: in its simulated sessions, in 30 % of steps the policy asks for amplitudes with hardly any logged step "
        "near them (logged steps span 0.00 to 1.00)",
    ]


@pytest.mark.parametrize(
    ("name", "value", "limit", "at_least", "shown", "limit_shown"),
    [
        ("far", 0.0, 0.2, False, "0 %", "at most 20 %"),
        ("far", 0.004, 0.2, False, "< 1 %", "at most 20 %"),
        ("thin", 0.456, 0.2, False, "46 %", "at most 20 %"),
        ("below_random_bound", None, 0.05, False, "—", "at most 5 %"),
        ("effective_sessions", 3.14, 10.0, True, "3.1 of 16", "at least 10"),
        ("horizon_of_ten", 7.0, 300.0, True, "7 of 300", "at least 300"),
        ("distance", 0.256, None, False, "0.26", ""),
    ],
)
def test_values_and_limits_are_told_in_the_units_of_the_check(
    name: str, value: float | None, limit: float | None, at_least: bool, shown: str, limit_shown: str
) -> None:
    check = CheckOut(name=name, value=value, limit=limit, at_least=at_least, verdict="told")
    assert (shown_value(check, 16), shown_limit(check)) == (shown, limit_shown)
    assert check.verdict in VERDICTS
