"""Designs of random sessions: laid out with the plan, bounded in mA, signed with it, and kept with the session that followed it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning.snapshots import take_snapshot
from app.planning.plans.designs import SideBound, delivered_ma, rounded_up
from app.platform import files
from app.study.repository import participant_by_code
from ml.designs import LOW_AMPLITUDE, LOW_SECONDS, DrawDensity, near_density
from ml.ope.importance import ImportanceSampling
from ml.policies.policy import ConstantPolicy
from ml.trajectories import from_parquet
from tests.app.ingest.conftest import table

RANDOM = {"random_sessions": 3, "minutes_per_session": 10, "seed": 5}


def settle(client: TestClient, **settings: Any) -> Any:
    return client.put("/api/v1/participants/P1/settings", json={"settings": settings})


def visit(client: TestClient, number: int, **more: Any) -> int:
    answer = client.post("/api/v1/participants/P1/visits", json={"number": number} | more)
    assert answer.status_code == 201, answer.text
    return int(answer.json()["id"])


def designed(client: TestClient, visit_id: int, **more: Any) -> list[dict[str, Any]]:
    answer = client.post(f"/api/v1/visits/{visit_id}/plan", json=RANDOM | more)
    assert answer.status_code == 201, answer.text
    sessions = answer.json()["sessions"]
    assert all((s["design"] is not None) == (s["controller"] == "random") for s in sessions)
    return [s["design"] for s in sessions if s["design"]]


def test_new_participants_have_the_stratified_design_and_settings_of_before_the_papers(client: TestClient, participant_code: str) -> None:
    settings = client.get("/api/v1/participants/P1").json()["settings"]
    assert (settings["design"], settings["design_ladder"], settings["early_visits"]) == ("stratified", False, 3)
    assert settle(client, design="paper").json()["design"] == "paper"
    assert settle(client, design="sobol").status_code == 422
    assert settle(client, early_visits=0).status_code == 422
    page = client.get("/participants/P1/settings").text
    assert "stratified, held draws" in page
    assert "The paper&#39;s: a new draw every step." in page


def test_levels_are_stratified_over_the_sessions_and_the_visits(client: TestClient, participant_code: str) -> None:
    settle(client, cdbs_amplitude_ma=3.0, lower_bound=0.3)
    levels = []
    for number in (2, 3, 4):
        found = designed(client, visit(client, number))
        assert len(found) == 3
        assert {d["design"] for d in found} == {"stratified"}
        coarse = [int((d["level"] - 0.3) / 0.7 * 3) for d in found]
        assert sorted(coarse) == [0, 1, 2]  # each visit has a low, a middle and a high session
        levels += [d["level"] for d in found]
    fine = sorted(int((level - 0.3) / 0.7 * 9) for level in levels)
    assert fine == list(range(9))  # over three visits every ninth of [B, 1] is used once
    later = designed(client, visit(client, 5))
    assert sorted(int((d["level"] - 0.3) / 0.7 * 3) for d in later) == [0, 1, 2]
    assert {d["seed"] for d in later} != {d["seed"] for d in found}


def test_drafting_again_draws_the_same_design(client: TestClient, participant_code: str) -> None:
    settle(client, cdbs_amplitude_ma=3.0)
    number = visit(client, 2)
    first = designed(client, number)
    assert designed(client, number, seed=99, note="another order") == first


def test_safety_comes_before_information(client: TestClient, participant_code: str) -> None:
    settle(client, cdbs_amplitude_ma=3.3, lower_bound=0.35)
    for number in (2, 3, 4):
        for d in designed(client, visit(client, number), minutes_per_session=20, total_minutes=300):
            steps = np.repeat([h["amplitude"] for h in d["holds"]], [h["steps"] for h in d["holds"]])
            assert steps.size == 600
            assert steps.min() >= 0.35
            low = np.flatnonzero(steps < LOW_AMPLITUDE)
            assert low.size * 2.0 <= LOW_SECONDS
            assert low.size == 0 or low.min() * 2.0 >= 1200 - LOW_SECONDS
            (bound,) = d["bounds"]
            assert (bound["side"], bound["cdbs_ma"], bound["lowest_ma"]) == (None, 3.3, 1.2)  # 0.35 x 3.3 = 1.155, rounded up
            assert min(delivered_ma(a, SideBound(**bound)) for a in steps) >= 0.35 * 3.3
            for h in d["holds"]:
                law = DrawDensity(d["level"], LOW_AMPLITUDE if h["start"] < 450 else 0.35)
                assert h["log_density"] == pytest.approx(float(np.log(law.density(h["amplitude"]))))


def test_no_draw_lies_below_the_lowest_amplitude_of_the_plan(client: TestClient, participant_code: str) -> None:
    """Amplitudes that a limit would cut are not drawn: the sheet names what the tablet gives, and densities are those of what was drawn."""
    settle(client, cdbs_amplitude_ma=3.0, lower_bound=0.3)
    number = visit(client, 2)
    open_ones = designed(client, number)
    assert min(h["amplitude"] for d in open_ones for h in d["holds"]) < 0.7
    body = client.post(f"/api/v1/visits/{number}/plan", json=RANDOM | {"min_ma": 2.1, "held": [{"amplitude_ma": 2.2}]}).json()
    random = [s for s in body["sessions"] if s["design"]]
    assert len(random) == 4
    for s in random:
        design = s["design"]
        assert (design["lower_bound"], s["min_ma"], design["bounds"][0]["lowest_ma"]) == (pytest.approx(0.7), 2.1, 2.1)
        assert min(h["amplitude"] for h in design["holds"]) >= 0.7
        law = {"stratified": DrawDensity, "near": near_density}[design["design"]](design["level"], design["lower_bound"])
        for h in design["holds"]:
            assert h["log_density"] == pytest.approx(float(np.log(law.density(h["amplitude"]))))
    levels = sorted(s["design"]["level"] for s in random if s["design"]["design"] == "stratified")
    assert [int((level - 0.7) / 0.3 * 3) for level in levels] == [0, 1, 2], "strata are those of what is left"
    settle(client, design="paper")
    assert [d["lower_bound"] for d in designed(client, number, min_ma=2.1)] == pytest.approx([0.7] * 3)
    nothing = client.post(f"/api/v1/visits/{number}/plan", json=RANDOM | {"min_ma": 3.0})
    assert (nothing.status_code, "Random sessions have nothing to draw" in nothing.text) == (422, True)


def test_rounding_never_goes_below_the_bound() -> None:
    assert rounded_up(0.9) == 0.9
    assert rounded_up(0.901) == 1.0
    bound = SideBound(None, 3.1, rounded_up(0.3 * 3.1), rounded_up(0.6 * 3.1))
    assert delivered_ma(0.3, bound) == 1.0
    assert delivered_ma(1.0, bound) == 3.1
    assert delivered_ma(0.5, bound) in (1.5, 1.6)


def test_a_ladder_stands_once_in_each_visit_and_the_papers_design_is_named_so(client: TestClient, participant_code: str) -> None:
    settle(client, cdbs_amplitude_ma=3.0, design_ladder=True)
    found = designed(client, visit(client, 2))
    assert sorted(d["design"] for d in found) == ["ladder", "stratified", "stratified"]
    (ladder,) = [d for d in found if d["design"] == "ladder"]
    assert [h["amplitude"] for h in ladder["holds"]] == [1.0, 0.8, 0.6, 0.4]
    assert {h["log_density"] for h in ladder["holds"]} == {None}
    settle(client, design="paper")
    number = visit(client, 3)
    assert [(d["design"], d["holds"]) for d in designed(client, number)] == [("paper", [])] * 3
    assert "the paper&#39;s design: a new draw every 2 s, uniform from 0.3 to 1 of cDBS" in client.get(f"/visits/{number}/plan").text


def test_a_plan_without_a_bound_in_milliamperes_cannot_be_signed(
    client: TestClient, participant_code: str, sign_plan: Callable[..., Any]
) -> None:
    number = visit(client, 2)
    settle(client, cdbs_amplitude_ma=None)
    assert designed(client, number)[0]["bounds"] == []
    assert "The plan cannot be signed: The cDBS amplitude of visit 2 is not known." in client.get(f"/visits/{number}/plan").text
    refused = sign_plan(number)
    assert refused.status_code == 422
    assert "State the cDBS amplitude" in refused.json()["hint"]
    settle(client, cdbs_amplitude_ma=2.5)
    unset = sign_plan(number)
    assert (unset.status_code, unset.json()["hint"]) == (409, "Draft the visit again.")
    assert designed(client, number)[0]["bounds"] != []
    signed = sign_plan(number).json()
    settle(client, cdbs_amplitude_ma=5.0)
    kept = client.get(f"/api/v1/visits/{number}/plan").json()
    assert kept["sessions"] == signed["sessions"]
    (bound,) = next(s["design"]["bounds"] for s in kept["sessions"] if s["design"])
    assert (bound["cdbs_ma"], bound["lowest_ma"], bound["low_ma"]) == (2.5, 0.8, 1.5)


def test_each_side_has_its_bound_and_the_page_and_the_sheet_say_it(client: TestClient, participant_code: str) -> None:
    sides = [{"hemisphere": "left", "amplitude_ma": 3.0}, {"hemisphere": "right", "amplitude_ma": 2.0}]
    number = visit(client, 2, cdbs_amplitudes=sides)
    designs = designed(client, number)
    assert [(b["side"], b["lowest_ma"]) for b in designs[0]["bounds"]] == [("left", 0.9), ("right", 0.6)]
    page = client.get(f"/visits/{number}/plan").text
    assert "never below 0.9 mA left, 0.6 mA right (0.3 of cDBS)" in page
    assert "back to cDBS at once" in page
    assert client.get(f"/api/v1/visits/{number}/plan.pdf").content[:4] == b"%PDF"


def upload(client: TestClient, fraction: np.ndarray, beta: float = 1.0) -> int:
    rng = np.random.default_rng(int(1000 * beta))
    rows = [(2 * k, float(beta + 0.1 * rng.random()), 1.0) for k in range(-9, 1)]
    rows += [(2 * (k + 1), float(beta + 0.1 * rng.random()), float(a)) for k, a in enumerate(fraction)]
    data = {"participant": "P1", "visit": "2", "controller": "random"}
    answer = client.post("/api/v1/uploads", data=data, files={"file": ("a.csv", table(rows))})
    assert answer.status_code == 201, answer.text
    return int(answer.json()["sessions"][0]["id"])


def buffer_of(db: Session) -> Any:
    db.rollback()
    snapshot = take_snapshot(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    db.commit()
    return from_parquet(files.read(snapshot.file_sha256))


@pytest.fixture
def approved(client: TestClient, participant_code: str, sign_plan: Callable[..., Any]) -> list[dict[str, Any]]:
    settle(client, cdbs_amplitude_ma=3.0, lower_bound=0.3, xi_beta=1.05)
    number = visit(client, 2)
    found = designed(client, number)
    assert sign_plan(number).status_code == 200
    return found


def amplitudes(design: dict[str, Any]) -> np.ndarray:
    wanted = np.repeat([h["amplitude"] for h in design["holds"]], [h["steps"] for h in design["holds"]])
    return np.maximum(np.round(wanted * 3.0, 1), 0.9) / 3.0  # as a device delivers it


def test_a_session_that_followed_the_plan_keeps_its_level_seed_and_densities(
    client: TestClient, db: Session, approved: list[dict[str, Any]]
) -> None:
    second = approved[1]
    session = upload(client, amplitudes(second))
    kept = client.get(f"/api/v1/sessions/{session}/conditions").json()
    assert (kept["design"], kept["seed"], kept["origin"]) == ("stratified", second["seed"], "stated")
    assert kept["design_parameters"] == {"level": second["level"], "holds": second["holds"]}
    (held,) = buffer_of(db).sessions
    assert [(h.start, h.steps, h.log_density) for h in held.holds] == [(h["start"], h["steps"], h["log_density"]) for h in second["holds"]]
    assert (held.random_bound, held.uniform_bound) == (0.3, None)
    assert (
        f"stratified, level {second['level']:.2f} of cDBS, {len(second['holds'])} held amplitudes"
        in client.get(f"/sessions/{session}").text
    )
    weighed = ImportanceSampling("wis", bandwidth=0.1).fit(buffer_of(db)).log_ratios(ConstantPolicy(0.7), 300)[0]
    assert np.count_nonzero(weighed) == len(second["holds"])


def test_what_came_after_a_return_to_cdbs_is_no_decision_of_the_design(
    client: TestClient, db: Session, approved: list[dict[str, Any]]
) -> None:
    first = min(approved, key=lambda d: d["level"])
    stopped = amplitudes(first)
    stopped[150:] = 1.0
    upload(client, stopped)
    (held,) = buffer_of(db).sessions
    end = held.holds[-1].start + held.holds[-1].steps
    assert 150 <= end <= 175
    assert held.holds[0].log_density is not None


def test_held_draws_of_no_plan_are_recognised_and_said(client: TestClient, db: Session, participant_code: str) -> None:
    settle(client, cdbs_amplitude_ma=3.0, xi_beta=1.05)
    visit(client, 2)
    rng = np.random.default_rng(0)
    held = upload(client, np.repeat(rng.uniform(0.3, 1.0, 15), 20), beta=1.0)
    drawn = upload(client, rng.uniform(0.3, 1.0, 300), beta=1.2)
    sessions = {s.session_id: s for s in buffer_of(db).sessions}
    assert {(h.steps, h.log_density) for h in sessions[held].holds} == {(20, None)}
    assert sessions[held].uniform_bound is None
    assert (sessions[drawn].holds, sessions[drawn].uniform_bound) == ((), 0.3)
    assert "not stated; the amplitudes are held (15 of them)" in client.get(f"/sessions/{held}").text
    assert "not stated; taken for the paper&#39;s, a new draw every step" in client.get(f"/sessions/{drawn}").text


def test_a_proposal_says_that_its_draws_are_held(client: TestClient, participant_code: str) -> None:
    settle(client, cdbs_amplitude_ma=3.0, xi_beta=1.05)
    visit(client, 2)
    fraction = np.repeat(np.random.default_rng(0).uniform(0.3, 1.0, 15), 20)
    rows = [(2 * (k + 1), 1.0 + 0.1 * (k % 3), float(a)) for k, a in enumerate(fraction)]
    answer = client.post("/api/v1/uploads", data={"participant": "P1"}, files={"file": ("a.csv", table(rows))})
    (proposal,) = answer.json()["sessions"]
    assert "the amplitudes are held (15 of them)" in client.get(f"/proposals/{proposal['id']}").text


def test_stated_holds_may_not_leave_out_steps(client: TestClient, participant_code: str) -> None:
    settle(client, cdbs_amplitude_ma=3.0, xi_beta=1.05)
    visit(client, 2)
    session = upload(client, np.full(60, 0.7))
    holds = [
        {"start": 0, "steps": 5, "amplitude": 0.7, "log_density": None},
        {"start": 6, "steps": 5, "amplitude": 0.7, "log_density": None},
    ]
    body = {"design": "stratified", "design_parameters": {"holds": holds}, "reason": "from the device's log"}
    answer = client.put(f"/api/v1/sessions/{session}/conditions", json=body)
    assert answer.status_code == 422
    assert "hold 2 starts at step 6; the one before ends at step 5" in answer.text
