"""A sweep's page on policies that should not be believed: below the baselines, not surely above cDBS, beyond the data."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning import sweeps_charts
from app.learning.policies import constant_onnx
from app.learning.snapshots import take_snapshot
from app.learning.sweeps import better_without_learning, candidates
from app.learning.training_compute import best_supported, stored_gains
from app.learning.trajectories import read_buffer
from app.platform import files
from app.platform.jobs import service as jobs
from app.study.repository import participant_by_code
from app.tables.learning import Policy, Sweep
from ml.ope.posterior.gains import PosteriorGain
from ml.policies.policy import ConstantPolicy
from ml.population.virtual import world
from ml.qoc import Qoc
from ml.returns import Gain
from ml.trajectories import ReplayBuffer
from tests.app.words import above_fold

Upload = Callable[..., int]
Store = Callable[..., Sweep]
BELOW = "Below what the random controller tried"
NOT_ABOVE = "No policy of this sweep is estimated above cDBS with confidence"
NOT_BETTER = "No policy of this sweep is estimated above a controller that learns nothing"


def estimated(gain: float, low: float, **told: Any) -> dict[str, Any]:
    return {"value": gain, "low": low, "standard_error": 1.0, "by": "posterior", "supported": True, "told": True} | told


def metrics(score: float, gain: float, low: float, below: float | None, **told: Any) -> dict[str, Any]:
    return {
        "held_out": {"update": [10], "score": [score]},
        "last": {},
        "best_update": 10,
        "gain_over_cdbs": estimated(gain, low, **told),
        "below_bound": None if below is None else {"bound": 0.3, "share": below},
    }


@pytest.fixture
def store(upload: Upload, db: Session) -> Store:
    """Function that stores a sweep of policies with given metrics, without training them."""
    upload("random")

    def make(*each: dict[str, Any], also: tuple[dict[str, Any], ...] = ()) -> Sweep:
        db.rollback()
        participant = participant_by_code(db, "P1", SYSTEM)
        snapshot = take_snapshot(db, participant, SYSTEM)
        job = jobs.submit(db, "train", participant.id, {}, "ada")
        half = {"controller": "constant 0.50", "score": 5.0, "mean_amplitude": 0.5, "gain_over_cdbs": estimated(2.5, 1.0)}
        rows = [{"controller": "cDBS", "score": 4.5, "mean_amplitude": 1.0, "gain_over_cdbs": estimated(0.0, 0.0)}, half, *also]
        sweep = Sweep(
            participant_id=participant.id, name="s", snapshot_id=snapshot.id, job_id=job.id, config={}, code_version="0", created_by="ada",
            baselines={"rows": rows, "best_constant": 1.0, "held_out_sessions": [1]},
        )  # fmt: skip
        db.add(sweep)
        db.flush()
        for k, told in enumerate(each):
            db.add(
                Policy(
                    participant_id=participant.id,
                    name=f"rl-{k}",
                    kind="trained",
                    algorithm="ddpg",
                    snapshot_id=snapshot.id,
                    settings_version_id=snapshot.settings_version_id,
                    sweep_id=sweep.id,
                    config={},
                    seed=k,
                    metrics=told,
                    code_version="0",
                    onnx_sha256=files.store(db, constant_onnx(0.5, 10)).sha256,
                    created_by="ada",
                )
            )
        db.commit()
        return sweep

    return make


def test_policies_that_score_below_cdbs_and_whose_gains_may_be_losses_are_told_so(store: Store, client: TestClient) -> None:
    sweep = store(metrics(4.0, 2.0, -1.0, 0.0), metrics(3.0, 1.0, 0.0, None))
    page = client.get(f"/sweeps/{sweep.id}").text
    assert NOT_BETTER in page
    assert "The best of those is constant 0.50" in page
    assert NOT_ABOVE in page
    assert BELOW not in page


def test_the_policy_with_the_largest_lower_bound_is_named_and_not_that_of_the_largest_gain(store: Store, client: TestClient) -> None:
    sweep = store(metrics(9.0, 8.0, 0.5, 0.05), metrics(7.0, 3.0, 2.0, 0.0))
    page = client.get(f"/sweeps/{sweep.id}").text
    assert "rl-1 has the largest lower bound" in page
    assert not any(words in page for words in (NOT_BETTER, NOT_ABOVE, BELOW))
    told = client.get(f"/api/v1/sweeps/{sweep.id}").json()["candidates"]
    assert [(c["name"], c["gain_over_cdbs"], c["gain_low"], c["below_bound"]) for c in told] == [
        ("rl-0", 8.0, 0.5, 0.05),
        ("rl-1", 3.0, 2.0, 0.0),
    ]


def saving(within: float, saves: float) -> dict[str, float]:
    return {"within": within, "saves": saves, "expected_saving": within * saves}


def test_the_largest_expected_saving_stands_first_and_not_cdbs_by_another_name(store: Store, client: TestClient) -> None:
    rows = [
        metrics(9.0, 0.4, -0.1, 0.0, **saving(1.0, 0.01)),
        metrics(5.0, 0.2, -2.0, 0.0, **saving(0.8, 0.4)),
        metrics(7.0, 0.3, -1.0, 0.0, beyond_margin=True, **saving(0.5, 0.9)),
    ]
    dose = {"controller": "best constant, 0.80", "score": 1.0, "mean_amplitude": 0.8}
    sweep = store(*rows, also=(dose | {"gain_over_cdbs": estimated(0.0, -1.0, **saving(0.9, 0.35))},))
    told = client.get(f"/api/v1/sweeps/{sweep.id}").json()["candidates"]
    assert [(c["name"], c["energy_saved"], c["within_margins"]) for c in told] == [
        ("rl-1", 0.4, 0.8),
        ("rl-0", 0.01, 1.0),
        ("rl-2", 0.9, 0.5),
    ]
    page = client.get(f"/sweeps/{sweep.id}").text
    assert "ordered by the energy saved times the chance of keeping the margins" in page
    assert re.search(r"40 <small[^>]*>\(80 %\)</small>", page), "rl-1 saves 40 %, with 80 % within all margins"
    assert NOT_BETTER not in page, "0.32 of the policy is more than 0.315 of the dose"
    more = dose | {"gain_over_cdbs": estimated(0.0, -1.0, **saving(0.9, 0.36))}
    assert better_without_learning(candidates(sweep), [more]) == "best constant, 0.80"


def test_a_policy_below_the_random_controllers_bound_in_more_than_a_twentieth_of_steps_is_flagged(
    store: Store, client: TestClient, db: Session
) -> None:
    sweep = store(metrics(9.0, 8.0, 0.5, 0.051), metrics(7.0, 3.0, 2.0, 0.05))
    page = client.get(f"/sweeps/{sweep.id}").text
    assert BELOW in page
    assert "rl-0 asks for less than 30 % of the cDBS amplitude in 5 % of the recorded steps." in page
    low, high = db.query(Policy).order_by(Policy.id)
    assert BELOW in client.get(f"/participants/P1/policies/{low.id}").text
    assert BELOW not in client.get(f"/participants/P1/policies/{high.id}").text


def test_a_sweep_from_before_gains_were_estimated_has_a_page_without_them(store: Store, client: TestClient) -> None:
    sweep = store({"held_out": {"update": [10], "score": [6.0]}, "last": {}, "best_update": 10})
    page = client.get(f"/sweeps/{sweep.id}").text
    assert not any(words in page for words in (NOT_ABOVE, BELOW, "largest lower bound"))


@pytest.fixture
def buffer(upload: Upload, db: Session) -> ReplayBuffer:
    """Four random and two cDBS sessions of a participant whose beta falls with the amplitude."""
    for controller in ("random", "random", "cdbs", "random", "random", "cdbs"):
        upload(controller)
    db.rollback()
    snapshot = take_snapshot(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    db.commit()
    return read_buffer(snapshot.file_sha256)


def test_cdbs_gains_nothing_over_itself_and_no_stimulation_is_not_supported_by_one_visit(buffer: ReplayBuffer) -> None:
    found = stored_gains(buffer, {"cDBS": ConstantPolicy(1.0), "off": ConstantPolicy(0.0)})
    same, off = found["cDBS"], found["off"]
    assert same is not None
    assert off is not None
    assert same["value"] == pytest.approx(0.0, abs=0.01)
    assert same["standard_error"] < 0.1 * off["standard_error"]
    assert off["low"] < off["value"] < 0
    assert (off["by"], off["supported"]) == ("posterior", False)


def test_the_best_constant_is_one_that_sessions_support_and_that_keeps_the_outcomes_within_their_margins() -> None:
    def one(value: float, supported: bool, within: float | None = None) -> PosteriorGain:
        return PosteriorGain(Gain(value, value, 1.0), supported, True, within)

    assert best_supported({"0.10": one(50.0, False), "0.70": one(3.0, True), "1.00": one(0.0, True)}, 0.8) == 0.7
    assert best_supported({"0.10": one(50.0, False)}, 0.8) is None
    doses = {"0.40": one(9.0, True, 0.3), "0.60": one(1.0, True, 0.8), "0.80": one(2.0, True, 0.97), "1.00": one(5.0, True, 1.0)}
    assert [best_supported(doses, level) for level in (0.5, 0.9, 0.99)] == [0.6, 0.8, 1.0], "energy saved, not the return"
    unsure = doses | {"0.60": one(1.0, True, 0.4)}
    assert best_supported(unsure, 0.0) == 0.8, "0.36 of the energy at 0.97 is more than 0.64 at 0.4 or 0.84 at 0.3"


def test_policies_are_ordered_by_the_posterior_and_not_by_the_held_out_score(store: Store, client: TestClient) -> None:
    sweep = store(metrics(9.0, 1.0, -1.0, 0.0), metrics(2.0, 6.0, 1.0, 0.0), metrics(8.0, 99.0, 50.0, 0.0, supported=False))
    told = client.get(f"/api/v1/sweeps/{sweep.id}").json()
    assert [c["name"] for c in told["candidates"]] == ["rl-1", "rl-0", "rl-2"]
    assert {c["gain_method"] for c in told["candidates"]} == {"posterior"}
    assert [b["gain_over_cdbs"] for b in told["baselines"]] == [0.0, 2.5]
    page = client.get(f"/sweeps/{sweep.id}").text
    assert "rl-1 has the largest lower bound" in page, "the larger bound of rl-2 is extrapolation"
    assert page.count(">no session near</span>") == 1


def test_what_is_probably_beyond_a_margin_stands_last_as_in_the_ranking(store: Store, client: TestClient) -> None:
    sweep = store(
        metrics(9.0, 6.0, 2.0, 0.0, beyond_margin=True), metrics(2.0, 3.0, 1.0, 0.0, beyond_margin=False), metrics(1.0, 2.0, 1.5, 0.0)
    )
    told = client.get(f"/api/v1/sweeps/{sweep.id}").json()
    assert [(c["name"], c["beyond_margin"]) for c in told["candidates"]] == [("rl-1", False), ("rl-2", None), ("rl-0", True)]
    page = client.get(f"/sweeps/{sweep.id}").text
    assert "rl-2 has the largest lower bound" in page, "the larger bound of rl-0 is of a return, and an outcome pays for it"
    assert page.count(">beyond a margin</span>") == 1


def test_a_stored_gain_says_whether_an_outcome_is_probably_beyond_its_margin() -> None:
    buffer, policies = world("A", 14).data("stratified"), {"0.50": ConstantPolicy(0.5), "0.90": ConstantPolicy(0.9)}
    wide = {"grasp_share": 0.9, "rating_points": 8.0, "tremor_points": 99.0}
    assert [g["beyond_margin"] for g in stored_gains(buffer, policies).values() if g] == [True, False]
    assert [g["beyond_margin"] for g in stored_gains(buffer, policies, wide).values() if g] == [False, False]
    unknown = replace(buffer, sessions=tuple(replace(s, qoc=Qoc()) for s in buffer.sessions))
    assert [g["beyond_margin"] for g in stored_gains(unknown, policies).values() if g] == [None, None], "no outcome is known"


def test_a_controller_without_learning_that_no_session_supports_is_marked(store: Store, client: TestClient) -> None:
    off = {"controller": "no DBS", "score": 1.0, "mean_amplitude": 0.0, "gain_over_cdbs": estimated(40.0, 30.0, supported=False)}
    sweep = store(metrics(9.0, 1.0, -1.0, 0.0), also=(off,))
    assert client.get(f"/sweeps/{sweep.id}").text.count(">no session near</span>") == 1


def test_where_sessions_cannot_order_policies_nothing_is_preferred(store: Store, client: TestClient) -> None:
    sweep = store(metrics(9.0, 1.0, 0.5, 0.0, told=False), metrics(2.0, 6.0, 1.0, 0.0, told=False))
    assert [c["name"] for c in client.get(f"/api/v1/sweeps/{sweep.id}").json()["candidates"]] == ["rl-0", "rl-1"]
    page = client.get(f"/sweeps/{sweep.id}").text
    assert "These sessions cannot order policies" in page
    assert "largest lower bound" not in page


def test_a_retired_policy_has_no_claim_to_replace_cdbs(store: Store, client: TestClient, db: Session) -> None:
    sweep = store(metrics(9.0, 6.0, 3.0, 0.0), metrics(2.0, 5.0, 1.0, 0.0))
    assert "rl-0 has the largest lower bound" in client.get(f"/sweeps/{sweep.id}").text
    policy = db.scalars(select(Policy).where(Policy.name == "rl-0")).one()
    retired = client.post(f"/participants/P1/policies/{policy.id}/retire", data={"reason": "made somebody dizzy"}, follow_redirects=True)
    assert retired.status_code == 200
    assert "rl-1 has the largest lower bound" in client.get(f"/sweeps/{sweep.id}").text


def test_gains_by_fitted_q_evaluation_of_older_sweeps_decide_nothing(store: Store, client: TestClient) -> None:
    old = {"value": 3.0, "low": 2.0, "standard_error": 1.0}
    sweep = store(
        metrics(1.0, 0.0, 0.0, 0.0) | {"gain_over_cdbs": old}, metrics(9.0, 0.0, 0.0, 0.0) | {"gain_over_cdbs": old | {"low": -1.0}}
    )
    told = client.get(f"/api/v1/sweeps/{sweep.id}").json()["candidates"]
    assert [(c["name"], c["gain_method"], c["gain_over_cdbs"]) for c in told] == [("rl-1", "fqe", 3.0), ("rl-0", "fqe", 3.0)]
    assert "largest lower bound" not in client.get(f"/sweeps/{sweep.id}").text


def test_each_policy_is_a_line_from_its_hyper_parameters_to_its_standing(store: Store, client: TestClient, db: Session) -> None:
    rows = [
        metrics(9.0, 8.0, 2.0, 0.0),
        metrics(8.0, 3.0, -1.0, 0.0),
        metrics(7.0, 2.0, 1.0, 0.2),
        metrics(6.0, 1.0, 0.5, 0.0, supported=False),
    ]
    sweep = store(*rows)
    for k, policy in enumerate(db.query(Policy).order_by(Policy.id).limit(4)):
        policy.config = {"actor_lr": 10.0 ** (k - 5), "critic_lr": 1e-3}
    db.commit()
    found = sweeps_charts.parallel(candidates(db.get_one(Sweep, sweep.id)))
    assert found is not None
    assert found.columns[1] == "Learning rate"
    assert "Rate of the values" not in found.columns  # all are alike
    assert [(row[0], row[1], row[-1]) for row in found.rows] == [
        ("rl-0", 1e-5, "estimated above cDBS"),
        ("rl-1", 1e-4, "not above cDBS with confidence"),
        ("rl-2", 1e-3, "below what the random controller tried"),
        ("rl-3", 1e-2, "no session near"),
    ]
    lines = re.findall(r'<path d="([^"]*)" fill="none" stroke="var\(--c-(\w+)\)"', str(found.figure))
    ends = {colour: d for d, colour in lines if colour != "border"}
    assert set(ends) == {"good", "accent", "bad", "warn"}
    # a learning rate a thousand times as large is at the other end of its axis
    heights = {colour: float(d[1:].split("L")[0].split()[1]) for colour, d in ends.items()}
    assert heights["accent"] == pytest.approx((2 * heights["good"] + heights["warn"]) / 3, abs=0.2)
    page = client.get(f"/sweeps/{sweep.id}").text
    assert "From hyper-parameters to what became of them" in page
    assert page.index("From hyper-parameters") < page.index("Policies of this sweep")


def test_one_policy_alone_is_compared_with_nothing(store: Store, db: Session) -> None:
    assert sweeps_charts.parallel(candidates(store(metrics(9.0, 8.0, 2.0, 0.0)))) is None


def test_the_page_of_a_trained_policy_leads_back_to_its_sweep_and_its_snapshot(store: Store, client: TestClient) -> None:
    sweep = store(metrics(4.0, 2.0, -1.0, 0.0))
    policy = client.get("/api/v1/participants/P1/policies", params={"kind": "trained"}).json()["items"][0]
    page = client.get(f"/participants/P1/policies/{policy['id']}")
    assert f"Sweep {sweep.name} Snapshot Snapshot {sweep.snapshot_id} " in above_fold(page.text)
    for path, words in ((f"/sweeps/{sweep.id}", policy["name"]), (f"/snapshots/{sweep.snapshot_id}", f"Snapshot {sweep.snapshot_id}")):
        assert f'<dd><a href="{path}">' in page.text
        assert words in client.get(path).text
